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

    /// Parses a time of day, with or without a date: `12:00:00.5`, `2026-11-28T12:00:00Z`, `1:02:03,250 PM`. A date that does not
    /// begin with its year is left out.
    pub fn clock(text: &str) -> Option<Self> {
        let text = text.trim().trim_matches('"').to_uppercase().replace(',', ".");
        let text = text.trim_end_matches("UTC").trim_end_matches("GMT").trim_end();
        let (text, afternoon) = match (text.strip_suffix("AM"), text.strip_suffix("PM")) {
            (Some(text), _) => (text.trim(), Some(0)),
            (_, Some(text)) => (text.trim(), Some(12)),
            _ => (text, None),
        };
        let (date, clock) = text.rsplit_once(['T', ' ']).unwrap_or(("", text));
        // The offset from UTC is the same at every row.
        let clock = clock.split(['Z', '+', '-']).next()?;
        // Minutes and seconds alone have a fraction, to differ from hours and minutes.
        let minutes = clock.split_once(':').filter(|(_, second)| second.contains('.') && !second.contains(':'));
        let clock = if minutes.is_some() { format!("0:{clock}") } else { clock.to_owned() };
        let mut parts = clock.split(':');
        let (hour, minute, second) = (parts.next()?.parse::<u32>().ok()?, parts.next()?, parts.next()?);
        let hour = afternoon.map_or(hour, |half| hour % 12 + half);
        // Milliseconds may follow a colon.
        let fraction = parts.next().map(|fraction| format!(".{fraction}")).unwrap_or_default();
        let date = date.replace(['/', '.'], "-");
        let dated = date.len() == 10 && date.as_bytes()[4] == b'-';
        let date = if dated { date.as_str() } else { "1970-01-01" };
        let whole = format!("{date}T{hour:02}:{minute:0>2}:{second:0>2}{fraction}Z");
        let time = humantime::parse_rfc3339(&whole).ok()?.duration_since(std::time::UNIX_EPOCH).ok()?;
        Some(Self::whole(i64::try_from(time.as_nanos()).ok()?, TimeUnit::Clock))
    }

    /// Adds a part of a second.
    pub fn plus(self, part: &Self) -> Self {
        Self {
            part: self.part + (part.whole as f64 + part.part) / part.unit.per_second() * self.unit.per_second(),
            ..self
        }
    }

    /// Returns the whole number of units.
    pub fn units(&self) -> i64 {
        self.whole
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
    fn times_of_day_are_read_with_or_without_a_date() {
        let since_s = |from, to| Stamp::clock(to).unwrap().since_s(&Stamp::clock(from).unwrap());
        for (from, to, expected_s) in [
            ("12:00:00.000", "12:00:00.010", 0.01),
            ("2026-11-28T23:59:59.5Z", "2026-11-29T00:00:00Z", 0.5),
            ("2026-11-28 12:00:00,250+02:00", "2026-11-28 12:00:00,500+02:00", 0.25),
            ("2026/11/28 9:05:01-05:00", "2026/11/28 9:05:02-05:00", 1.0),
            ("28.11.2026 12:00:00", "28.11.2026 12:00:01", 1.0),
            ("2026-11-28 12:00:00 UTC", "2026-11-28 12:00:01 UTC", 1.0),
            ("11:59:59 AM", "12:00:01 PM", 2.0),
            ("12:00:00:100", "12:00:00:350", 0.25),
            ("59:59.75", "1:00:00", 0.25),
        ] {
            assert!((since_s(from, to) - expected_s).abs() < 1e-12, "{from} {to}: {}", since_s(from, to));
        }
        for text in ["", "12", "12:30", "25:00:00", "12:61:00", "a:b:c", "12:00:xx"] {
            assert!(Stamp::clock(text).is_none(), "{text}");
        }
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
