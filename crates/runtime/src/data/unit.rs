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
        let name = name.trim().to_lowercase();
        let found = TIMES.iter().position(|words| words.split(' ').any(|word| word == name));
        found.map(|index| Self::NUMBERS[index])
    }
}

/// The spellings of [`TimeUnit::NUMBERS`]; the last ones of µs are UTF-8 and the code page 437, read as Latin-1.
const TIMES: [&str; 4] = [
    "s sec secs second seconds с сек",
    "ms msec msecs millis millisec millisecond milliseconds мс",
    "us µs μs usec usecs micros microsec microsecond microseconds мкс âµs î¼s æs",
    "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds нс",
];

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

    /// Parses a unit: an angle per time, such as `rad/s`, `dps`, `deg/h`, `mdps`, `µrad/s`, `rpm` or `rev/s`, and longer spellings. An
    /// angle alone means per second. A unit without name is a scale.
    pub fn parse(name: &str) -> Option<Self> {
        let lower = name.to_lowercase().replace('¹', "1");
        let text: String = lower.chars().filter_map(degree).filter(|c| c.is_alphanumeric() || *c == '°').collect();
        let mut prefixes = PREFIXES.iter();
        let rad_s = prefixes.find_map(|(prefix, part)| Some(part * angle_per_second(text.strip_prefix(prefix)?)?))?;
        let same = |unit: &&Self| (unit.rad_s() / rad_s - 1.0).abs() < 1e-12;
        Some(Self::NUMBERS.iter().find(same).copied().unwrap_or(Self::Scale(rad_s)))
    }
}

/// Parts of a unit, as words and their size.
const PREFIXES: [(&str, f64); 13] = [
    ("", 1.0),
    ("milli", 1e-3),
    ("m", 1e-3),
    ("micro", 1e-6),
    ("µ", 1e-6),
    ("μ", 1e-6),
    ("u", 1e-6),
    ("nano", 1e-9),
    ("n", 1e-9),
    ("centi", 1e-2),
    ("c", 1e-2),
    ("deci", 1e-1),
    ("d", 1e-1),
];
/// In rad; those of the first two rows may stand alone.
const ANGLES: [(&str, f64); 5] = {
    use std::f64::consts::{PI, TAU};
    [
        ("rad radian radians рад", 1.0),
        ("deg degree degrees град °", PI / 180.0),
        ("arcsec arcsecond arcseconds", PI / 648e3),
        ("arcmin arcminute arcminutes", PI / 10.8e3),
        ("rev revs revolution revolutions turn turns rot rotations", TAU),
    ]
};
/// In 1/s.
const PER_TIME: [(&str, f64); 3] = [
    ("s ps pers sec persec second persecond s1 sec1 с сек", 1.0),
    ("min permin minute perminute min1", 1.0 / 60.0),
    ("h hr perh perhr hour perhour h1", 1.0 / 3600.0),
];
/// Shorter names of an angle per time, in rad/s.
const SHORT: [(&str, f64); 3] = {
    use std::f64::consts::{PI, TAU};
    [("dps", PI / 180.0), ("dph", PI / 648e3), ("rpm rmin umin trmin", TAU / 60.0)]
};

/// Returns an angle per time in rad/s.
fn angle_per_second(text: &str) -> Option<f64> {
    let named = |list: &[(&str, f64)], text: &str| {
        list.iter().find(|(words, _)| words.split(' ').any(|word| word == text)).map(|(_, size)| *size)
    };
    let mut angles = ANGLES.iter().flat_map(|(words, rad)| words.split(' ').map(move |word| (word, *rad)));
    let parts = angles.find_map(|(word, rad)| Some(rad * named(&PER_TIME, text.strip_prefix(word)?)?));
    parts.or_else(|| named(&ANGLES[..2], text)).or_else(|| named(&SHORT, text))
}

/// Replaces the signs that stand for a degree in other encodings.
fn degree(letter: char) -> Option<char> {
    match letter {
        // Ordinal indicator, ring above, ring operator, superscript zero, and Mac OS Roman and DOS read as Latin-1.
        'º' | '˚' | '∘' | '⁰' | '¡' | 'ø' => Some('°'),
        // UTF-8 read as Latin-1 has this letter before the sign; GBK and EUC have these after it.
        'â' | 'ã' | 'ë' => None,
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
            // Seven digits, without zeros behind them.
            Self::Scale(rad_s) => {
                let digits = format!("{rad_s:.6e}");
                return write!(f, "units of {} rad/s", digits.parse::<f64>().unwrap_or(*rad_s));
            }
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
            (RadiansPerSecond, "rad/s|rad_s|rad s^-1|rad s⁻¹|rad·s-1|rad/sec|Radians per second"),
            (DegreesPerSecond, "deg/s|dps|DPS|°/s|º/s|˚/s|¡/s|Â°/s|degrees/second|град/с|¡ã/s|⁰/s|degs"),
            (MillidegreesPerSecond, "mdps|mdeg/s|m°/s|millidegrees per second"),
            (MilliradiansPerSecond, "mrad/s|mrad|millirad/s"),
            (RevolutionsPerMinute, "rpm|rev/min|turns per minute|r/min|U/min|tr/min"),
            (RevolutionsPerSecond, "rev/s|turns/s"),
        ] {
            spellings.split('|').for_each(|text| assert_eq!(RateUnit::parse(text), Some(unit), "{text}"));
        }
        for text in "|/s|\u{fffd}/s|?/s|rps|rad/s^2|rad/s2|rad/s/s|deg/ms|Hz|turn|rev|Grad/s|arcsec|min".split('|') {
            assert_eq!(RateUnit::parse(text), None, "{text}");
        }
        for (text, rad_s) in [
            ("deg/h", 1.0_f64.to_radians() / 3600.0),
            ("°/hr", 1.0_f64.to_radians() / 3600.0),
            ("degrees per minute", 1.0_f64.to_radians() / 60.0),
            ("µrad/s", 1e-6),
            ("urad/s", 1e-6),
            ("nrad/s", 1e-9),
            ("cdps", 1.0_f64.to_radians() / 100.0),
            ("arcsec/s", 1.0_f64.to_radians() / 3600.0),
            ("rad/min", 1.0 / 60.0),
        ] {
            let found = RateUnit::parse(text).map_or(f64::NAN, RateUnit::rad_s);
            assert!((found / rad_s - 1.0).abs() < 1e-12, "{text}: {found}");
        }
        let times = ["µs", "Âµs", "MS", "s"].map(TimeUnit::parse);
        assert_eq!(
            times,
            [TimeUnit::Microseconds, TimeUnit::Microseconds, TimeUnit::Milliseconds, TimeUnit::Seconds].map(Some)
        );
        assert_eq!(["", "min"].map(TimeUnit::parse), [None; 2]);
    }
}
