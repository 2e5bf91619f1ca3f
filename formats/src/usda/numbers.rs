//! Numbers as the values of arrays.

/// Text in the making, with memory for one number.
pub(super) struct Numbers {
    pub(super) text: Vec<u8>,
    real: zmij::Buffer,
    integer: itoa::Buffer,
}

impl Numbers {
    /// Nothing yet, with room for so many bytes.
    pub(super) fn with_capacity(byte_count: usize) -> Numbers {
        Numbers {
            text: Vec::with_capacity(byte_count),
            real: zmij::Buffer::new(),
            integer: itoa::Buffer::new(),
        }
    }

    /// The shortest decimals that read back as the same number.
    pub(super) fn real<T: zmij::Float>(&mut self, number: T) {
        let digits = self.real.format_finite(number);
        self.text.extend_from_slice(digits.strip_suffix(".0").unwrap_or(digits).as_bytes());
    }

    pub(super) fn integer(&mut self, number: impl itoa::Integer) {
        self.text.extend_from_slice(self.integer.format(number).as_bytes());
    }

    /// One number, or several in parentheses.
    pub(super) fn tuple<T: Copy>(&mut self, values: &[T], mut number: impl FnMut(&mut Numbers, T)) {
        if let [value] = values {
            return number(self, *value);
        }
        self.text.push(b'(');
        for (place, value) in values.iter().enumerate() {
            if place > 0 {
                self.separate();
            }
            number(self, *value);
        }
        self.text.push(b')');
    }

    /// What stands between values.
    pub(super) fn separate(&mut self) {
        self.text.extend_from_slice(b", ");
    }
}

/// Three numbers as text.
pub(super) fn triple<T: zmij::Float + Copy>(values: [T; 3]) -> String {
    let mut numbers = Numbers::with_capacity(48);
    numbers.tuple(&values, Numbers::real);
    String::from_utf8(numbers.text).unwrap_or_default() // digits and signs
}
