//! The query of a request, and percent-decoding of names in its path.

/// The decoded value of `name` in a query; `None` if it is missing or not valid UTF-8.
pub(super) fn value_of(query: Option<&str>, name: &str) -> Option<String> {
    let pairs = query?.split('&').filter_map(|pair| pair.split_once('='));
    let mut values = pairs.filter(|(key, _)| *key == name).map(|(_, value)| value);
    decoded(&values.next()?.replace('+', " "))
}

/// Percent-decodes a text; `None` if an escape is malformed or the result is not valid UTF-8.
pub(super) fn decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let [first, after @ ..] = rest {
        rest = match (first, after) {
            (b'%', [high, low, after @ ..]) => {
                let digit = |byte: &u8| char::from(*byte).to_digit(16);
                bytes.push(u8::try_from(digit(high)? * 16 + digit(low)?).ok()?);
                after
            }
            (b'%', _) => return None,
            (byte, after) => {
                bytes.push(*byte);
                after
            }
        };
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percent_signs_are_decoded_once() {
        assert_eq!(decoded("dam%20%C3%A4.%31").as_deref(), Some("dam ä.1"));
        assert_eq!(decoded("%252e").as_deref(), Some("%2e"));
        for wrong in ["%", "%2", "%zz", "%ff", "a%+1"] {
            assert_eq!(decoded(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn values_are_found_by_name() {
        assert_eq!(value_of(Some("a=1&after=dam+1%2b&b"), "after").as_deref(), Some("dam 1+"));
        assert_eq!(value_of(Some("after"), "after"), None);
        assert_eq!(value_of(None, "after"), None);
    }
}
