//! Finds the column and the unit of each quantity: from the options, else by name. Must not guess between two candidates.

use super::form::{DataError, Meaning, Options};
use super::unit::{RateUnit, TimeUnit};
use std::path::Path;

/// Names of a time stamp, without unit and axis.
const STAMPS: [&str; 9] =
    ["time", "t", "timestamp", "stamp", "seconds", "elapsed", "secondselapsed", "elapsedtime", "timesec"];
/// Names of an angular velocity, without unit and axis.
const RATES: [&str; 16] = [
    "w",
    // As in ax, ay, az, gx, gy, gz.
    "g",
    "omega",
    "gyro",
    "gyr",
    "gyroscope",
    "rate",
    "rates",
    "angularvelocity",
    "angularrate",
    "angvel",
    "rotationrate",
    "av",
    "angularspeed",
    "gyrorate",
    "gyroraw",
];

/// Returns the words of a name in lower case.
fn words(name: &str) -> Vec<String> {
    let name = name.to_lowercase();
    let words = name.split(|letter: char| !letter.is_alphanumeric() && letter != '°');
    words.filter(|word| !word.is_empty()).map(str::to_owned).collect()
}

/// Returns the unit of time in a name: its last word.
fn time_unit(name: &str) -> Option<TimeUnit> {
    words(name).last().and_then(|word| TimeUnit::parse(word))
}

/// Returns true if a name is that of a time stamp.
fn is_stamp(name: &str) -> bool {
    let mut words = words(name);
    if words.len() > 1 && time_unit(name).is_some() {
        words.pop();
    }
    STAMPS.contains(&words.concat().as_str())
}

/// Returns the unit of angular velocity in a name.
fn rate_unit(name: &str) -> Option<RateUnit> {
    let words = words(name);
    let has_word = |unit: &[&str]| words.iter().any(|word| unit.contains(&word.as_str()));
    match (has_word(&["rad", "rads", "radians"]), has_word(&["deg", "dps", "degrees", "°"])) {
        (true, false) => Some(RateUnit::RadiansPerSecond),
        (false, true) => Some(RateUnit::DegreesPerSecond),
        _ => None,
    }
}

/// Returns the axis, 0 to 2, of the angular velocity with this name.
fn rate_axis(name: &str) -> Option<usize> {
    const UNITS: [&str; 11] = ["rad", "rads", "radians", "deg", "degrees", "dps", "°", "s", "sec", "per", "second"];
    let mut words = words(name);
    words.retain(|word| !UNITS.contains(&word.as_str()));
    let last = words.pop()?;
    let axis = |letter: &str| ["x", "y", "z"].iter().position(|axis| *axis == letter);
    let index = |digit: &str| ["0", "1", "2"].iter().position(|index| *index == digit);
    // A separate word, as in `gyro_x` and `omega_rad_s[0]`, or the end of a word, as in `wx`.
    let (stem, axis) = match axis(&last).or_else(|| index(&last)) {
        Some(axis) => (words.concat(), axis),
        None => {
            let at = last.char_indices().last()?.0;
            (words.concat() + &last[..at], axis(&last[at..])?)
        }
    };
    RATES.contains(&stem.as_str()).then_some(axis)
}

/// The positions of a log's columns.
#[derive(Debug, Clone)]
pub struct Places {
    /// The column of stamps.
    pub time: usize,
    /// The columns of the rates; `None` for a missing one.
    pub rates: [Option<usize>; 3],
    /// The column that separates segments.
    pub by: Option<usize>,
    /// The names and units of the columns.
    pub meaning: Meaning,
}

/// Finds the columns by the options and their names.
pub fn find(names: &[String], path: &Path, options: &Options) -> Result<Places, DataError> {
    let refuse = |reason: String, remedy: &str| {
        let columns = names.iter().take(40).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        let columns = if names.len() > 40 { format!("{columns}, …") } else { columns };
        DataError::Column { path: path.to_owned(), reason, remedy: remedy.to_owned(), columns }
    };
    let named = |wanted: &str| {
        let found: Vec<usize> = (0..names.len()).filter(|index| names[*index] == wanted).collect();
        match found[..] {
            [index] => Ok(index),
            [] => Err(refuse(format!("there is no column `{wanted}`"), "name an existing one")),
            _ => Err(refuse(format!("{} columns are called `{wanted}`", found.len()), "rename all but one")),
        }
    };
    // In a file without header the names are numbers.
    let numbers = names.iter().all(|name| name.parse::<f64>().is_ok());
    let unnamed =
        if options.header && numbers { "; if it has no header say so, and give columns by number" } else { "" };
    let time = match &options.time {
        Some(name) => named(name)?,
        None => {
            let found: Vec<usize> = (0..names.len()).filter(|index| is_stamp(&names[*index])).collect();
            match found[..] {
                [index] => index,
                _ => {
                    let count = if found.is_empty() { "no column is" } else { "more than one column is" };
                    let remedy = format!("name the column of time{unnamed}");
                    return Err(refuse(format!("{count} known to be time"), &remedy));
                }
            }
        }
    };
    let rates = match &options.rates {
        Some(given) => {
            let mut rates = [None; 3];
            for (rate, name) in rates.iter_mut().zip(given) {
                *rate = if name == "-" { None } else { Some(named(name)?) };
            }
            rates
        }
        None => {
            let mut rates = [None; 3];
            for (axis, rate) in rates.iter_mut().enumerate() {
                let found: Vec<usize> = (0..names.len()).filter(|i| rate_axis(&names[*i]) == Some(axis)).collect();
                *rate = match found[..] {
                    [] => None,
                    [index] => Some(index),
                    _ => {
                        let both = format!("`{}` and `{}`", names[found[0]], names[found[1]]);
                        return Err(refuse(
                            format!("{both} may both be a rate"),
                            "name the three columns of the rates",
                        ));
                    }
                };
            }
            rates
        }
    };
    for (axis, rate) in rates.iter().enumerate() {
        if rate.is_none() && options.needed[axis] {
            let letter = ["x", "y", "z"][axis];
            let reason = format!("no column is known to be the rate about {letter}");
            return Err(refuse(reason, &format!("name the three columns of the rates{unnamed}")));
        }
    }
    let chosen: Vec<usize> = rates.iter().flatten().copied().chain([time]).collect();
    if let Some(twice) = chosen.iter().enumerate().find_map(|(n, i)| chosen[..n].contains(i).then_some(*i)) {
        return Err(refuse(format!("`{}` is named twice", names[twice]), "name each column once"));
    }
    let by = options.by.as_deref().map(named).transpose()?;
    let given_time = options.time_unit.or_else(|| time_unit(&names[time]));
    let units: Vec<_> = rates.iter().flatten().map(|index| rate_unit(&names[*index])).collect();
    let given_rate = match (options.rate_unit, units.first()) {
        (Some(unit), _) => Some(unit),
        (None, Some(first)) if units.iter().all(|unit| unit == first) => *first,
        _ => {
            return Err(refuse("the names of the rates tell different units".to_owned(), "tell the unit of all three"));
        }
    };
    let name = |index: Option<usize>| index.map_or_else(|| "-".to_owned(), |index| names[index].clone());
    let mut assumed = Vec::new();
    assumed.extend(given_time.is_none().then_some("time"));
    assumed.extend(given_rate.is_none().then_some("rate"));
    let meaning = Meaning {
        time: (name(Some(time)), given_time.unwrap_or(TimeUnit::Seconds)),
        rates: (rates.map(name), given_rate.unwrap_or(RateUnit::RadiansPerSecond)),
        assumed,
    };
    Ok(Places { time, rates, by, meaning })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(names: &[&str], options: &Options) -> Result<Places, String> {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        find(&names, "log.csv".as_ref(), options).map_err(|error| error.to_string())
    }

    #[test]
    fn names_that_loggers_use_are_known() {
        use RateUnit::{DegreesPerSecond, RadiansPerSecond};
        use TimeUnit::{Milliseconds, Nanoseconds, Seconds};
        for (names, time, rate) in [
            (["time_s", "omega_x_rad_s", "omega_y_rad_s", "omega_z_rad_s"], Seconds, RadiansPerSecond),
            (
                ["Time (s)", "Gyroscope x (rad/s)", "Gyroscope y (rad/s)", "Gyroscope z (rad/s)"],
                Seconds,
                RadiansPerSecond,
            ),
            (["t [ms]", "gyro_x[deg/s]", "gyro_y[deg/s]", "gyro_z[deg/s]"], Milliseconds, DegreesPerSecond),
            (["timestamp_ns", "wx_dps", "wy_dps", "wz_dps"], Nanoseconds, DegreesPerSecond),
            (["time_s", "omega_rad_s[0]", "omega_rad_s[1]", "omega_rad_s[2]"], Seconds, RadiansPerSecond),
        ] {
            let places = found(&names, &Options::default()).unwrap();
            assert_eq!((places.time, places.rates), (0, [Some(1), Some(2), Some(3)]), "{names:?}");
            assert_eq!((places.meaning.time.1, places.meaning.rates.1), (time, rate), "{names:?}");
            assert!(places.meaning.assumed.is_empty(), "{names:?}");
        }
        let bare = found(&["wz", "t", "wx", "wy", "ax", "ay", "az"], &Options::default()).unwrap();
        assert_eq!((bare.time, bare.rates), (1, [Some(2), Some(3), Some(0)]));
        assert_eq!(bare.meaning.assumed, ["time", "rate"]);
    }

    #[test]
    fn what_is_not_clear_is_refused_with_what_to_do() {
        let refused = |names: &[&str], options: &Options| found(names, options).unwrap_err();
        let none = Options::default();
        assert!(refused(&["0.1", "1", "2", "3"], &none).contains("if it has no header say so"));
        assert!(refused(&["time", "wx", "wy"], &none).contains("about z; name the three columns"));
        assert!(refused(&["time", "wx", "wy", "wz", "gyro_x"], &none).contains("`wx` and `gyro_x`"));
        assert!(refused(&["time", "t", "wx", "wy", "wz"], &none).contains("more than one column"));
        assert!(refused(&["time", "wx_dps", "wy_dps", "wz_rad_s"], &none).contains("different units"));
        let named = |time: &str, rates: [&str; 3]| Options {
            time: Some(time.to_owned()),
            rates: Some(rates.map(str::to_owned)),
            ..Options::default()
        };
        assert!(refused(&["a", "b", "c", "d"], &named("e", ["b", "c", "d"])).contains("no column `e`"));
        assert!(refused(&["a", "b", "c", "b"], &named("a", ["b", "c", "b"])).contains("2 columns are called `b`"));
        assert!(refused(&["a", "b", "c", "d"], &named("a", ["b", "c", "a"])).contains("`a` is named twice"));
        let blind = Options { needed: [true, true, false], ..named("a", ["b", "c", "-"]) };
        assert_eq!(found(&["a", "b", "c"], &blind).unwrap().rates, [Some(1), Some(2), None]);
    }
}
