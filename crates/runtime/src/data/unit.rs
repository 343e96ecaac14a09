//! Units of a log's columns, as people write them.

use std::fmt;

/// A unit of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TimeUnit {
    /// s
    Seconds,
    /// ms
    Milliseconds,
    /// us
    Microseconds,
    /// ns
    Nanoseconds,
    /// The time of day, or date and time.
    Clock,
    /// A counter that rises this many times per second.
    Count(f64),
}

impl TimeUnit {
    /// The units that a number without one may have.
    pub(super) const NUMBERS: [Self; 4] = [Self::Seconds, Self::Milliseconds, Self::Microseconds, Self::Nanoseconds];

    /// Returns the number of units per second.
    pub fn per_second(self) -> f64 {
        match self {
            Self::Seconds => 1.0,
            Self::Milliseconds => 1e3,
            Self::Microseconds => 1e6,
            Self::Nanoseconds | Self::Clock => 1e9,
            Self::Count(per_second) => per_second,
        }
    }

    /// Parses a unit: `s`, `ms`, `us`, `ns`, or the word.
    pub fn parse(name: &str) -> Option<Self> {
        Some(match name.trim().to_lowercase().as_str() {
            "s" | "sec" | "secs" | "second" | "seconds" | "с" | "сек" => Self::Seconds,
            "ms" | "msec" | "msecs" | "millis" | "millisec" | "millisecond" | "milliseconds" | "мс" => {
                Self::Milliseconds
            }
            "us" | "µs" | "μs" | "usec" | "usecs" | "micros" | "microsec" | "microsecond" | "microseconds" | "мкс" => {
                Self::Microseconds
            }
            "ns" | "nsec" | "nsecs" | "nanos" | "nanosec" | "nanosecs" | "nanosecond" | "nanoseconds" | "нс" => {
                Self::Nanoseconds
            }
            _ => return None,
        })
    }
}

impl fmt::Display for TimeUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Seconds => "s",
            Self::Milliseconds => "ms",
            Self::Microseconds => "us",
            Self::Nanoseconds => "ns",
            Self::Clock => "clock time",
            Self::Count(per_second) => return write!(f, "1/{per_second} s"),
        })
    }
}

/// A unit of angular velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RateUnit {
    /// rad/s
    RadiansPerSecond,
    /// deg/s
    DegreesPerSecond,
    /// mrad/s
    MilliradiansPerSecond,
    /// mdeg/s, also called mdps
    MillidegreesPerSecond,
    /// rpm
    RevolutionsPerMinute,
    /// rev/s
    RevolutionsPerSecond,
    /// This many rad/s.
    Scale(f64),
}

impl RateUnit {
    /// The units that a number without one may have, the most usual first.
    pub(super) const NUMBERS: [Self; 6] = [
        Self::RadiansPerSecond,
        Self::DegreesPerSecond,
        Self::MillidegreesPerSecond,
        Self::MilliradiansPerSecond,
        Self::RevolutionsPerMinute,
        Self::RevolutionsPerSecond,
    ];

    /// Returns the unit in rad/s.
    pub fn rad_s(self) -> f64 {
        use std::f64::consts::{PI, TAU};
        match self {
            Self::RadiansPerSecond => 1.0,
            Self::DegreesPerSecond => PI / 180.0,
            Self::MilliradiansPerSecond => 1e-3,
            Self::MillidegreesPerSecond => PI / 180e3,
            Self::RevolutionsPerMinute => TAU / 60.0,
            Self::RevolutionsPerSecond => TAU,
            Self::Scale(rad_s) => rad_s,
        }
    }

    /// Parses a unit: `rad/s`, `deg/s`, `dps`, `mdps`, `mrad/s`, `rpm`, `rev/s`, and their longer spellings. A unit of angle alone
    /// means per second.
    pub fn parse(name: &str) -> Option<Self> {
        let lower = name.to_lowercase().replace('¹', "1");
        let text: String = lower.chars().filter_map(degree).filter(|c| c.is_alphanumeric() || *c == '°').collect();
        let per_second = |rest: &str| {
            ["s", "ps", "pers", "sec", "persec", "second", "persecond", "s1", "sec1", "с", "сек"].contains(&rest)
        };
        let angle = |text: &str| {
            let after = |words: &[&str]| words.iter().find_map(|word| text.strip_prefix(word).map(str::to_owned));
            match (after(&["radians", "radian", "rad", "рад"]), after(&["degrees", "degree", "deg", "град", "°"]))
            {
                (Some(rest), _) if rest.is_empty() || per_second(&rest) => Some(Self::RadiansPerSecond),
                (_, Some(rest)) if rest.is_empty() || per_second(&rest) => Some(Self::DegreesPerSecond),
                _ => (text == "dps").then_some(Self::DegreesPerSecond),
            }
        };
        let milli = || match angle(text.strip_prefix("milli").or_else(|| text.strip_prefix('m'))?)? {
            Self::RadiansPerSecond => Some(Self::MilliradiansPerSecond),
            _ => Some(Self::MillidegreesPerSecond),
        };
        let turns = || {
            let words = ["revolutions", "revolution", "revs", "rev", "turns", "turn", "rotations"];
            words.iter().filter_map(|word| text.strip_prefix(word)).find_map(|rest| {
                let per_minute = ["min", "permin", "minute", "perminute", "min1"].contains(&rest);
                let unit = if per_minute { Self::RevolutionsPerMinute } else { Self::RevolutionsPerSecond };
                (per_minute || per_second(rest)).then_some(unit)
            })
        };
        let rpm = || (text == "rpm").then_some(Self::RevolutionsPerMinute);
        angle(&text).or_else(milli).or_else(turns).or_else(rpm)
    }
}

/// Replaces the signs that stand for a degree in other encodings.
fn degree(letter: char) -> Option<char> {
    match letter {
        // Ordinal indicator, ring above, ring operator, and Mac OS Roman and DOS read as Latin-1.
        'º' | '˚' | '∘' | '¡' | 'ø' => Some('°'),
        // UTF-8 read as Latin-1 has this letter before the sign.
        'â' => None,
        letter => Some(letter),
    }
}

impl fmt::Display for RateUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::RadiansPerSecond => "rad/s",
            Self::DegreesPerSecond => "deg/s",
            Self::MilliradiansPerSecond => "mrad/s",
            Self::MillidegreesPerSecond => "mdps",
            Self::RevolutionsPerMinute => "rpm",
            Self::RevolutionsPerSecond => "rev/s",
            Self::Scale(rad_s) => return write!(f, "{rad_s} rad/s"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_read_as_people_write_them() {
        use RateUnit::*;
        for (unit, spellings) in [
            (
                RadiansPerSecond,
                &["rad/s", "rad_s", "rad s^-1", "rad s⁻¹", "rad·s-1", "rad/sec", "Radians per second"][..],
            ),
            (
                DegreesPerSecond,
                &["deg/s", "dps", "DPS", "°/s", "º/s", "˚/s", "¡/s", "Â°/s", "degrees/second", "град/с"],
            ),
            (MillidegreesPerSecond, &["mdps", "mdeg/s", "m°/s", "millidegrees per second"]),
            (MilliradiansPerSecond, &["mrad/s", "mrad", "millirad/s"]),
            (RevolutionsPerMinute, &["rpm", "rev/min", "turns per minute"]),
            (RevolutionsPerSecond, &["rev/s", "turns/s"]),
        ] {
            spellings.iter().for_each(|text| assert_eq!(RateUnit::parse(text), Some(unit), "{text}"));
        }
        for text in
            ["", "/s", "\u{fffd}/s", "?/s", "rps", "deg/h", "rad/s^2", "rad/s2", "Hz", "turn", "rev", "cdps", "Grad/s"]
        {
            assert_eq!(RateUnit::parse(text), None, "{text}");
        }
        for (text, unit) in
            [("µs", TimeUnit::Microseconds), ("μs", TimeUnit::Microseconds), ("MS", TimeUnit::Milliseconds)]
        {
            assert_eq!(TimeUnit::parse(text), Some(unit), "{text}");
        }
        assert_eq!(TimeUnit::parse("min"), None);
    }
}
