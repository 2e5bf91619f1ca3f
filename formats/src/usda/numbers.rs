//! Formats numbers as array values.

/// Text under construction, with a buffer for formatting numbers.
pub(super) struct NumberWriter {
    pub(super) text: Vec<u8>,
    real: zmij::Buffer,
    integer: itoa::Buffer,
}

impl NumberWriter {
    /// An empty text with capacity for `byte_count` bytes.
    pub(super) fn with_capacity(byte_count: usize) -> NumberWriter {
        NumberWriter {
            text: Vec::with_capacity(byte_count),
            real: zmij::Buffer::new(),
            integer: itoa::Buffer::new(),
        }
    }

    /// Appends the shortest decimals that parse back to the same number.
    pub(super) fn real<T: zmij::Float>(&mut self, number: T) {
        let digits = self.real.format_finite(number);
        self.text.extend_from_slice(digits.strip_suffix(".0").unwrap_or(digits).as_bytes());
    }

    pub(super) fn integer(&mut self, number: impl itoa::Integer) {
        self.text.extend_from_slice(self.integer.format(number).as_bytes());
    }

    /// Appends one number, or several in parentheses.
    pub(super) fn tuple<T: Copy>(&mut self, values: &[T], mut number: impl FnMut(&mut NumberWriter, T)) {
        if let [value] = values {
            return number(self, *value);
        }
        self.text.push(b'(');
        for (index, value) in values.iter().enumerate() {
            if index > 0 {
                self.separate();
            }
            number(self, *value);
        }
        self.text.push(b')');
    }

    /// Appends the separator of values.
    pub(super) fn separate(&mut self) {
        self.text.extend_from_slice(b", ");
    }
}

/// Formats three numbers as a tuple.
pub(super) fn triple<T: zmij::Float + Copy>(values: [T; 3]) -> String {
    let mut numbers = NumberWriter::with_capacity(48);
    numbers.tuple(&values, NumberWriter::real);
    String::from_utf8(numbers.text).unwrap_or_default() // digits and signs
}
