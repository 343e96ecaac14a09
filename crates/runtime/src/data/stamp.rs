//! Time stamps of files, without rounding. A 64-bit float cannot hold nanoseconds since 1970, so whole part and fraction are
//! separate.

use super::unit::TimeUnit;

/// A time stamp in the unit of its column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stamp {
    whole: i64,
    part: f64,
    unit: TimeUnit,
}

impl Stamp {
    /// Creates a stamp of a whole number of units.
    pub fn whole(whole: i64, unit: TimeUnit) -> Self {
        Self { whole, part: 0.0, unit }
    }

    /// Creates a stamp from a number of units; `None` unless it is finite and below 2^62 in magnitude.
    pub fn float(value: f64, unit: TimeUnit) -> Option<Self> {
        let whole = value.trunc();
        // 2^62 is exact as a float.
        (whole.abs() < (1_i64 << 62) as f64).then_some(Self { whole: whole as i64, part: value - whole, unit })
    }

    /// Parses a decimal number with optional minus sign and point; `None` for any other text.
    pub fn digits(text: &str, unit: TimeUnit) -> Option<Self> {
        let (whole, part) = text.split_once('.').unwrap_or((text, ""));
        let decimal = |digits: &str| digits.bytes().all(|digit| digit.is_ascii_digit());
        if !decimal(whole.strip_prefix('-').unwrap_or(whole)) || !decimal(part) {
            return None;
        }
        let value: i64 = whole.parse().ok().filter(|value: &i64| value.unsigned_abs() < 1 << 62)?;
        let part: f64 = if part.is_empty() { 0.0 } else { text[whole.len()..].parse().ok()? };
        Some(Self { whole: value, part: if whole.starts_with('-') { -part } else { part }, unit })
    }

    /// Returns the time from an earlier stamp to this one, s.
    pub fn since_s(&self, earlier: &Self) -> f64 {
        // No overflow: both whole parts are below 2^62 in magnitude.
        ((self.whole - earlier.whole) as f64 + (self.part - earlier.part)) / self.unit.per_second()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nanoseconds_since_1970_keep_every_digit() {
        let stamp = |text| Stamp::digits(text, TimeUnit::Nanoseconds).unwrap();
        assert_eq!(stamp("1763800000000000007").since_s(&stamp("1763800000000000000")), 7e-9);
        let stamp = |text| Stamp::digits(text, TimeUnit::Seconds).unwrap();
        let since_s = stamp("1763800000.000010020").since_s(&stamp("1763800000"));
        assert!((since_s - 1.002e-5).abs() < 1e-18, "{since_s:e}");
        assert_eq!(stamp("-0.25").since_s(&stamp("0.25")), -0.5);
        assert_eq!(stamp("5.").since_s(&Stamp::whole(4, TimeUnit::Seconds)), 1.0);
    }

    #[test]
    fn invalid_texts_and_numbers_are_refused() {
        for text in ["", ".", "-", "1e3", "1.2.3", "0x1", "1-", "+1", "9223372036854775807", "1.-2"] {
            assert!(Stamp::digits(text, TimeUnit::Seconds).is_none(), "{text}");
        }
        assert!(Stamp::float(1e300, TimeUnit::Seconds).is_none());
        assert!(Stamp::float(f64::NAN, TimeUnit::Seconds).is_none());
        let stamp = |value| Stamp::float(value, TimeUnit::Milliseconds).unwrap();
        assert!((stamp(1500.5).since_s(&stamp(-0.5)) - 1.501).abs() < 1e-15);
    }
}
