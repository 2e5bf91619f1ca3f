//! Formats numbers and counts for messages.

/// A count with its noun, in the plural unless the count is 1.
pub fn pluralize(count: usize, noun: &str) -> String {
    if count == 1 {
        return format!("1 {noun}");
    }
    match (noun.strip_suffix("vertex"), noun.strip_suffix("triangle without area")) {
        (Some(before), _) => format!("{count} {before}vertices"),
        (_, Some(_)) => format!("{count} triangles without area"),
        _ => format!("{count} {noun}s"),
    }
}

/// A number with six significant digits, without trailing zeros.
pub fn significant(value: f64) -> String {
    // Round in decimal digits and parse the result: printing it again gives no more digits than these.
    shortest(format!("{value:.5e}").parse().unwrap_or(value))
}

/// A number with all of its digits. A very large or very small one is in scientific notation if that is
/// shorter.
pub fn shortest(value: f64) -> String {
    let (plain, scientific) = (value.to_string(), format!("{value:e}"));
    let is_usual = (1e-4..1e9).contains(&value.abs());
    if is_usual || plain.len() <= scientific.len() { plain } else { scientific }
}

/// Removes the digits that binary rounding adds to a product of decimal numbers: 0.020000000000000004 becomes
/// 0.02.
pub fn rounded_to_digits(number: f64) -> f64 {
    format!("{number:.12e}").parse().unwrap_or(number)
}

/// A positive number rounded down to three significant digits.
pub fn rounded_down(value: f64) -> String {
    let near: f64 = format!("{value:.2e}").parse().unwrap_or(value);
    let below = if near > value { near - 10f64.powf(value.log10().floor() - 2.0) } else { near };
    significant(below)
}

/// A word that an option accepts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Word {
    /// The word on the command line and in files.
    pub name: &'static str,
    /// Other names for it, which mean the same.
    pub others: &'static [&'static str],
    /// What it means, one sentence without a full stop.
    pub help: &'static str,
}

impl Word {
    /// What it means, with its other names.
    pub fn full_help(&self) -> String {
        match self.others {
            [] => self.help.to_owned(),
            others => format!("{}; also called {}", self.help, others.join(", ")),
        }
    }
}

/// Defines an enum whose variants are words on the command line and in files, with conversions in both
/// directions. Other names for a variant follow its word: `Noisy = "noisy" | "flip"`.
macro_rules! word_enum {
    (
        $(#[$attribute:meta])*
        pub enum $name:ident {
            $(#[doc = $help:literal] $(#[$variant_attribute:meta])* $variant:ident = $word:literal $(| $other:literal)*,)+
        }
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
        pub enum $name {
            $(
                #[doc = $help]
                $(#[$variant_attribute])*
                #[serde(rename = $word $(, alias = $other)*)]
                $variant,
            )+
        }

        impl $name {
            /// Every variant.
            pub const ALL: &'static [$name] = &[$($name::$variant),+];

            /// The words of the variants, in the same order, with their help.
            pub const WORDS: &'static [$crate::words::Word] =
                &[$(
                    $crate::words::Word { name: $word, others: &[$($other),*], help: $help.trim_ascii() }
                ),+];

            /// The word for this variant on the command line and in files.
            pub fn name(self) -> &'static str {
                match self {
                    $($name::$variant => $word),+
                }
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }

        impl std::str::FromStr for $name {
            type Err = String;

            fn from_str(word: &str) -> Result<$name, String> {
                match word {
                    $($word $(| $other)* => Ok($name::$variant),)+
                    _ => Err(format!("`{word}` is unknown: expected one of {}", [$($word),+].join(", "))),
                }
            }
        }
    };
}
pub(crate) use word_enum;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_down_never_exceeds_the_number() {
        for (value, expected) in [
            (0.123_456, "0.123"),
            (0.129_999, "0.129"),
            (9.999e-7, "9.99e-7"),
            (12345.0, "12300"),
            (0.5, "0.5"),
        ] {
            assert_eq!(rounded_down(value), expected);
        }
    }

    #[test]
    fn significant_keeps_six_digits_at_any_magnitude() {
        for (value, expected) in [
            (0.0, "0"),
            (0.5, "0.5"),
            (1.0 / 3.0, "0.333333"),
            (0.1 + 0.2, "0.3"),
            (3f64.sqrt() * 0.025, "0.0433013"),
            (3f64.sqrt() * 1e-7, "1.73205e-7"),
            (1e-7, "1e-7"),
            (-1234.5678, "-1234.57"),
            (12_345_678.0, "12345700"),
            (2.5e30, "2.5e30"),
            (5e-324, "5e-324"),
            (f64::MAX, "1.79769e308"),
            (f64::INFINITY, "inf"),
        ] {
            assert_eq!(significant(value), expected);
        }
    }

    #[test]
    fn scientific_notation_is_used_where_it_is_shorter() {
        for (value, expected) in [
            (0.0, "0"),
            (-0.001, "-0.001"),
            (1000.0, "1000"),
            (0.1f64.next_up(), "0.10000000000000002"),
            (1e-5, "1e-5"),
            (2.5e30, "2.5e30"),
            (123_456_789_012.5, "123456789012.5"),
            (f64::NEG_INFINITY, "-inf"),
            (f64::NAN, "NaN"),
        ] {
            assert_eq!(shortest(value), expected);
        }
    }

    #[test]
    fn pluralize_uses_the_plural_unless_the_count_is_one() {
        assert_eq!(pluralize(1, "vertex"), "1 vertex");
        assert_eq!(pluralize(0, "non-manifold vertex"), "0 non-manifold vertices");
        assert_eq!(pluralize(2, "triangle without area"), "2 triangles without area");
        assert_eq!(pluralize(3, "frame"), "3 frames");
    }
}
