//! Finds the column and the unit of each quantity: from the options, else by name. Must not guess between two candidates.

use super::form::{Cut, DataError, Meaning, Options};
use super::names::{Axis, Claim, RateName, force_name, rate_claim, rate_name, stamp_rank, time_claim, words};
use super::plausible::since_1970;
use super::stamp::Stamp;
use super::table::number;
use super::unit::{RateUnit, TimeUnit};
use std::path::Path;

/// The positions of a log's columns.
#[derive(Debug, Clone)]
pub struct Places {
    /// The column of stamps; `None` if the rows are counted.
    pub time: Option<usize>,
    /// The column with the rest of the stamp, and its unit.
    pub time_part: Option<(usize, TimeUnit)>,
    /// The columns of the rates; `None` for a missing one.
    pub rates: [Option<usize>; 3],
    /// The columns of an accelerometer, where free motion is searched.
    pub forces: Option<[usize; 3]>,
    /// The column that separates segments.
    pub by: Option<usize>,
    /// The names and units of the columns.
    pub meaning: Meaning,
}

/// A search for columns.
struct Search<'a> {
    names: &'a [String],
    path: &'a Path,
    options: &'a Options,
}

/// Finds the columns by the options and their names. `first` returns the text of a column in the first row.
pub fn find(
    names: &[String],
    path: &Path,
    options: &Options,
    first: impl Fn(usize) -> String,
) -> Result<Places, DataError> {
    let search = Search { names, path, options };
    let by = options.by.as_deref().map(|name| search.named(name)).transpose()?;
    let (time, time_part) = search.time()?;
    let rates = search.rates()?;
    let chosen: Vec<usize> = rates.iter().flatten().copied().chain(time).collect();
    if let Some(twice) = chosen.iter().enumerate().find_map(|(n, i)| chosen[..n].contains(i).then_some(*i)) {
        return Err(search.refuse(format!("`{}` is named twice", names[twice]), "name each column once"));
    }
    let stamp = time.map(first).unwrap_or_default();
    let clock = Stamp::clock(&stamp).is_some();
    let given_time = match time {
        _ if options.time_unit.is_some() => options.time_unit,
        _ if time_part.is_some() => Some(TimeUnit::Seconds),
        _ if clock => Some(TimeUnit::Clock),
        Some(column) => search.known(column, time_claim(&names[column]).0, "--time-unit s, ms, us or ns")?,
        None => None,
    };
    let given_rate = search.rate_unit(&rates)?;
    let forces = search.best(&force_name).ok().flatten().filter(|_| options.cut == Cut::Free);
    let forces = forces.and_then(|[x, y, z]| Some([x?, y?, z?]));
    let name = |index: Option<usize>| index.map_or_else(|| "-".to_owned(), |index| names[index].clone());
    let mut assumed = Vec::new();
    assumed.extend(given_time.is_none().then_some("time"));
    assumed.extend(given_rate.is_none().then_some("rate"));
    let time_name = time.map_or_else(|| "the row's number".to_owned(), |index| names[index].clone());
    let meaning = Meaning {
        time: (time_name, given_time.or_else(|| since_1970(number(&stamp, true)? as i64)).unwrap_or(TimeUnit::Seconds)),
        rates: (rates.map(name), given_rate.unwrap_or(RateUnit::RadiansPerSecond)),
        assumed,
        found: String::new(),
        forces: forces.map(|columns| columns.map(|column| names[column].clone())),
    };
    Ok(Places { time, time_part, rates, forces, by, meaning })
}

impl Search<'_> {
    fn refuse(&self, reason: String, remedy: &str) -> DataError {
        let columns = self.names.iter().take(40).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        let columns = if self.names.len() > 40 { format!("{columns}, …") } else { columns };
        DataError::Column { path: self.path.to_owned(), reason, remedy: remedy.to_owned(), columns }
    }

    /// Returns the remedy for a log without header.
    fn unnamed(&self) -> &'static str {
        // In a file without header the names are numbers.
        let numbers = self.names.iter().all(|name| name.parse::<f64>().is_ok());
        if !self.options.unnamed && numbers { "; if it has no header say so, and give columns by number" } else { "" }
    }

    /// Returns the column with a name, in any case, or with a number from 1.
    fn named(&self, wanted: &str) -> Result<usize, DataError> {
        let all = |same: &dyn Fn(&str) -> bool| -> Vec<usize> {
            (0..self.names.len()).filter(|index| same(&self.names[*index])).collect()
        };
        let mut found = all(&|name| name == wanted);
        if found.is_empty() {
            found = all(&|name| name.trim().to_lowercase() == wanted.trim().to_lowercase());
        }
        let number = wanted.parse::<usize>().ok().filter(|number| (1..=self.names.len()).contains(number));
        match (&found[..], number) {
            ([index], _) => Ok(*index),
            ([], Some(number)) => Ok(number - 1),
            ([], None) => {
                let remedy = "name an existing one, or give its number";
                Err(self.refuse(format!("there is no column `{wanted}`"), remedy))
            }
            _ => Err(self.refuse(format!("{} columns are called `{wanted}`", found.len()), "give its number")),
        }
    }

    /// Returns the column of stamps, and that of their rest.
    #[allow(clippy::type_complexity, reason = "it is taken apart at once")]
    fn time(&self) -> Result<(Option<usize>, Option<(usize, TimeUnit)>), DataError> {
        let given = self.options.time.as_deref().map(|name| self.named(name)).transpose()?;
        let pairs: Vec<_> = (0..self.names.len()).filter_map(|index| self.stamp_part(index)).collect();
        let pair = match (given, &pairs[..]) {
            (Some(given), pairs) => pairs.iter().find(|(whole, ..)| *whole == given),
            (None, [pair]) => Some(pair),
            (None, _) => None,
        };
        if let Some((whole, part, unit)) = pair.filter(|_| self.options.time_unit.is_none()) {
            return Ok((Some(*whole), Some((*part, *unit))));
        }
        if given.is_some() || matches!(self.options.time_unit, Some(TimeUnit::Count(_))) {
            return Ok((given, None));
        }
        let ranked = || (0..self.names.len()).filter_map(|index| Some((stamp_rank(&self.names[index])?, index)));
        let best = ranked().map(|(rank, _)| rank).min();
        let of_best: Vec<usize> = ranked().filter(|(rank, _)| Some(*rank) == best).map(|(_, index)| index).collect();
        let known = of_best.iter().find(|index| matches!(time_claim(&self.names[**index]).0, Claim::Known(_)));
        match (&of_best[..], known) {
            ([index], _) => Ok((Some(*index), None)),
            // All of them are times; the unit of this one is certain.
            (_, Some(index)) => Ok((Some(*index), None)),
            _ => {
                let count = if of_best.is_empty() { "no column is" } else { "more than one column is" };
                let remedy = format!(
                    "name the column of time (--time), or give the rows per second (--rate-hz){}",
                    self.unnamed()
                );
                Err(self.refuse(format!("{count} known to be time"), &remedy))
            }
        }
    }

    /// Returns the column of whole seconds that belongs to one of nanoseconds or microseconds, with this one and its unit.
    fn stamp_part(&self, part: usize) -> Option<(usize, usize, TimeUnit)> {
        let ends = |name: &str| {
            let mut words = words(name);
            let unit = TimeUnit::parse(&words.pop()?)?;
            Some((words.concat(), unit))
        };
        let (stem, unit) = ends(&self.names[part])?;
        let is_whole = |name: &String| ends(name) == Some((stem.clone(), TimeUnit::Seconds));
        let whole = self.names.iter().position(is_whole)?;
        let stamps = stem.is_empty() || ["stamp", "time", "tv", "t"].iter().any(|end| stem.ends_with(end));
        let small = matches!(unit, TimeUnit::Nanoseconds | TimeUnit::Microseconds);
        (small && stamps).then_some((whole, part, unit))
    }

    /// Returns the columns of the rates.
    fn rates(&self) -> Result<[Option<usize>; 3], DataError> {
        let mut rates = [None; 3];
        if let Some(given) = &self.options.rates {
            for (rate, name) in rates.iter_mut().zip(given) {
                *rate = if name == "-" { None } else { Some(self.named(name)?) };
            }
        } else if let Some(found) = self.rates_by_name()? {
            rates = found;
        }
        for (axis, rate) in rates.iter().enumerate() {
            if rate.is_none() && !self.options.may_lack[axis] {
                let letter = ["x", "y", "z"][axis];
                let reason = format!("no column is known to be the rate about {letter}");
                let remedy = "name the three columns of the rates, or their numbers (--rates)";
                return Err(self.refuse(reason, &format!("{remedy}{}", self.unnamed())));
            }
        }
        Ok(rates)
    }

    /// Returns the best columns that their names give; `None` without any.
    fn rates_by_name(&self) -> Result<Option<[Option<usize>; 3]>, DataError> {
        let file = self.path.file_stem().map(|stem| stem.to_string_lossy().to_lowercase()).unwrap_or_default();
        let gyro = file.contains("gyro") || file.contains("angular");
        self.best(&|name| rate_name(name, gyro))
    }

    /// Returns the best columns of three axes among those that `parse` knows; `None` without any.
    fn best(&self, parse: &dyn Fn(&str) -> Option<RateName>) -> Result<Option<[Option<usize>; 3]>, DataError> {
        let named: Vec<(usize, RateName)> =
            self.names.iter().enumerate().filter_map(|(index, name)| Some((index, parse(name)?))).collect();
        let mut groups: Vec<(usize, [Option<usize>; 3])> = Vec::new();
        for (_, first) in &named {
            let group = || named.iter().filter(|(_, name)| name.stem == first.stem);
            let has = |digit| group().any(|(_, name)| name.axis == Axis::Number(digit));
            let mut columns = [None; 3];
            for (index, name) in group() {
                let axis = match name.axis {
                    Axis::Letter(axis) => axis,
                    // From 0 where 0 exists, from 1 where 3 does.
                    Axis::Number(number) if has(0) && !has(3) => number,
                    Axis::Number(number) if has(3) && !has(0) => number - 1,
                    Axis::Number(_) => continue,
                };
                if let Some(earlier) = columns[axis].replace(*index) {
                    return Err(self.both(earlier, *index));
                }
            }
            if columns != [None; 3] && !groups.iter().any(|(_, known)| *known == columns) {
                groups.push((first.rank, columns));
            }
        }
        let complete = |columns: &[Option<usize>; 3]| columns.iter().all(Option::is_some);
        let enough =
            |columns: &[Option<usize>; 3]| (0..3).all(|axis| columns[axis].is_some() || self.options.may_lack[axis]);
        for wanted in [&complete as &dyn Fn(&[Option<usize>; 3]) -> bool, &enough, &|_| true] {
            let fitting: Vec<_> = groups.iter().filter(|(_, columns)| wanted(columns)).collect();
            let best = fitting.iter().map(|(rank, _)| rank).min();
            let of_best: Vec<_> =
                fitting.iter().filter(|(rank, _)| Some(rank) == best).map(|(_, columns)| columns).collect();
            match of_best[..] {
                [] => {}
                [columns] => return Ok(Some(*columns)),
                [first, second, ..] => {
                    let some = |columns: &[Option<usize>; 3]| columns.iter().flatten().copied().next().unwrap_or(0);
                    return Err(self.both(some(first), some(second)));
                }
            }
        }
        Ok(None)
    }

    fn both(&self, first: usize, second: usize) -> DataError {
        let reason = format!("`{}` and `{}` may both be a rate", self.names[first], self.names[second]);
        self.refuse(reason, "name the three columns of the rates, or their numbers (--rates)")
    }

    /// Returns the unit of the rates, if an option or their names give it.
    fn rate_unit(&self, rates: &[Option<usize>; 3]) -> Result<Option<RateUnit>, DataError> {
        if self.options.rate_unit.is_some() {
            return Ok(self.options.rate_unit);
        }
        let mut units = Vec::new();
        for index in rates.iter().flatten() {
            let remedy =
                "--rate-unit with one such as rad/s, deg/s, mdps or rpm, or --rate-scale and the rad/s per unit";
            units.push(self.known(*index, rate_claim(&self.names[*index]).0, remedy)?);
        }
        match units.first() {
            Some(first) if units.iter().all(|unit| unit == first) => Ok(*first),
            None => Ok(None),
            Some(_) => Err(self.refuse(
                "the names of the rates tell different units".to_owned(),
                "give that of all three (--rate-unit)",
            )),
        }
    }

    /// Returns a unit that is known.
    fn known<U>(&self, column: usize, claim: Claim<U>, remedy: &'static str) -> Result<Option<U>, DataError> {
        match claim {
            Claim::Absent => Ok(None),
            Claim::Known(unit) => Ok(Some(unit)),
            Claim::Unknown(unit) => Err(DataError::UnknownUnit {
                path: self.path.to_owned(),
                column: self.names[column].clone(),
                unit,
                remedy,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(names: &[&str], options: &Options) -> Result<Places, String> {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        find(&names, "log.csv".as_ref(), options, |_| String::new()).map_err(|error| error.to_string())
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
            (["Zeit (s)", "P (rad/s)", "Q (rad/s)", "R (rad/s)"], Seconds, RadiansPerSecond),
            (["time, ms", "ωₓ [deg/s]", "ωᵧ [deg/s]", "ωᶻ [deg/s]"], Milliseconds, DegreesPerSecond),
            (["t_rel (s)", "rotRateX_dps", "rotRateY_dps", "rotRateZ_dps"], Seconds, DegreesPerSecond),
            (["t (s)", "Rot x (deg/s)", "Rot y (deg/s)", "Rot z (deg/s)"], Seconds, DegreesPerSecond),
            (["elapsed (s)", "x-axis (deg/s)", "y-axis (deg/s)", "z-axis (deg/s)"], Seconds, DegreesPerSecond),
        ] {
            let places = found(&names, &Options::default()).unwrap();
            assert_eq!((places.time, places.rates), (Some(0), [Some(1), Some(2), Some(3)]), "{names:?}");
            assert_eq!((places.meaning.time.1, places.meaning.rates.1), (time, rate), "{names:?}");
            assert!(places.meaning.assumed.is_empty(), "{names:?}");
        }
        let bare = found(&["wz", "t", "wx", "wy", "ax", "ay", "az"], &Options::default()).unwrap();
        assert_eq!((bare.time, bare.rates), (Some(1), [Some(2), Some(3), Some(0)]));
        assert_eq!(bare.meaning.assumed, ["time", "rate"]);
        let autopilot = found(&["timestamp", "timestamp_sample", "gx", "gy", "gz"], &Options::default()).unwrap();
        assert_eq!(autopilot.time, Some(1));
        assert_eq!(found(&["date", "wx", "wy", "wz"], &Options::default()).unwrap().time, Some(0));
        assert_eq!(found(&["date", "time", "wx", "wy", "wz"], &Options::default()).unwrap().time, Some(1));
    }

    #[test]
    fn an_accelerometer_is_found_where_free_motion_is_searched() {
        let free = Options { cut: Cut::Free, ..Options::default() };
        for names in [
            ["ax", "ay", "az"],
            ["acc_x", "acc_y", "acc_z"],
            ["ax_m_s2", "ay_m_s2", "az_m_s2"],
            ["Accelerometer x (m/s^2)", "Accelerometer y (m/s^2)", "Accelerometer z (m/s^2)"],
            ["linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z"],
            ["AccX", "AccY", "AccZ"],
            ["accSmooth[0]", "accSmooth[1]", "accSmooth[2]"],
            ["accelX_g", "accelY_g", "accelZ_g"],
            ["a_RS_S_x [m s^-2]", "a_RS_S_y [m s^-2]", "a_RS_S_z [m s^-2]"],
            ["userAccelerationX", "userAccelerationY", "userAccelerationZ"],
        ] {
            let whole = [&["t", "wx", "wy", "wz"][..], &names].concat();
            assert_eq!(found(&whole, &free).unwrap().forces, Some([4, 5, 6]), "{names:?}");
            assert_eq!(found(&whole, &Options::default()).unwrap().forces, None);
            // One that shows gravity is better.
            let both = [&whole[..], &["userAccelX", "userAccelY", "userAccelZ"]].concat();
            let best =
                if names[0].starts_with("user") || names[0].starts_with("linear") { None } else { Some([4, 5, 6]) };
            assert_eq!(found(&both, &free).unwrap().forces, best, "{names:?}");
        }
        for names in [["mag_x", "mag_y", "mag_z"], ["acc_bias_x", "acc_bias_y", "acc_bias_z"], ["ax", "ay", "x"]] {
            assert_eq!(
                found(&[&["t", "wx", "wy", "wz"][..], &names].concat(), &free).unwrap().forces,
                None,
                "{names:?}"
            );
        }
    }

    #[test]
    fn what_is_not_clear_is_refused_with_what_to_do() {
        let refused = |names: &[&str], options: &Options| found(names, options).unwrap_err();
        let none = Options::default();
        assert!(refused(&["0.1", "1", "2", "3"], &none).contains("if it has no header say so"));
        assert!(refused(&["time", "wx", "wy"], &none).contains("about z; name the three columns"));
        assert!(
            refused(&["time", "wx", "wy", "wz", "gyro_x", "gyro_y", "gyro_z"], &none).contains("`wx` and `gyro_x`")
        );
        assert!(refused(&["time", "t", "wx", "wy", "wz"], &none).contains("more than one column"));
        assert!(refused(&["time", "wx_dps", "wy_dps", "wz_rad_s"], &none).contains("different units"));
        let scaled = ["t_s", "gyro_x_deg_s_100", "gyro_y_deg_s_100", "gyro_z_deg_s_100"];
        assert!(refused(&scaled, &none).contains("`x deg s 100` is not a known unit"));
        assert!(refused(&["t_s", "wx rad/s/s", "wy rad/s/s", "wz rad/s/s"], &none).contains("about x"));
        assert!(refused(&["t_s", "wx (rad/s/s)", "wy (rad/s/s)", "wz (rad/s/s)"], &none).contains("not a known unit"));
        assert!(refused(&["t_s", "q", "r"], &none).contains("about x"));
        for names in [["wheel_wx", "omega_err_y", "rw_omega_z"], ["steps_x (deg)", "steps_y (deg)", "steps_z (deg)"]] {
            assert!(refused(&[&["t_s"], &names[..]].concat(), &none).contains("about x"));
        }
        let named = |time: &str, rates: [&str; 3]| Options {
            time: Some(time.to_owned()),
            rates: Some(rates.map(str::to_owned)),
            ..Options::default()
        };
        assert!(refused(&["a", "b", "c", "d"], &named("e", ["b", "c", "d"])).contains("no column `e`"));
        assert!(refused(&["a", "b", "c", "b"], &named("a", ["b", "c", "b"])).contains("2 columns are called `b`"));
        assert!(refused(&["a", "b", "c", "d"], &named("a", ["b", "c", "a"])).contains("`a` is named twice"));
        let blind = Options { may_lack: [false, false, true], ..named("a", ["b", "c", "-"]) };
        assert_eq!(found(&["a", "b", "c"], &blind).unwrap().rates, [Some(1), Some(2), None]);
    }
}
