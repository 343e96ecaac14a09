//! Finds the column and the unit of each quantity: from the options, else by name. Must not guess between two candidates.

use super::form::{Cut, DataError, Meaning, Options};
use super::plausible::since_1970;
use super::stamp::Stamp;
use super::table::number;
use super::unit::{RateUnit, TimeUnit};
use std::path::Path;

/// Names of a time stamp, without unit; the first list that has one decides.
const STAMPS: [&str; 3] = [
    "headerstamp sampletimefine timestampsample",
    "elapsed elapsedtime timeelapsed",
    "time t timestamp stamp loggingtime systemtime unixtime devicetime sensortime datetime timeboot rostime \
     utc clock epoch simtime runtime reltime trel tow gpstow zeit temps tiempo tempo czas",
];
/// Words that make a name with another of them a time stamp, and words that prevent it.
const STAMP_WORDS: &str = "time timestamp stamp elapsed";
const NO_STAMP_WORDS: &str = "delta exposure zone interval diff of";
/// Names of an angular velocity, without unit and axis; `g` as in ax, ay, az, gx, gy, gz.
const RATES: &str = "w g ω omega gyro gyr gyros gyroscope rate rates bodyrate bodyrates angularvelocity angularrate angvel \
                     rotationrate av avel angularspeed gyrorate gyroraw gyroadc motionrotationrate turnrate rotrate angrate anglerate \
                     drehrate winkelgeschwindigkeit vitesseangulaire velocidadangular 角速度";
/// Words that make a longer name that of an angular velocity, and parts of words that do.
const RATE_WORDS: &str = "w omega gyr gyro ω";
const RATE_PARTS: &str =
    "gyro angularvelocity angularrate angvel angularspeed rotationrate rotrate bodyrate angrate anglerate omega";
/// Words of quantities that are related to an angular velocity.
const NO_RATE_WORDS: &str = "bias offset cov covariance std stddev var variance accel acc acceleration linear mag temp temperature \
                             setpoint desired des target cmd command ref error err noise wheel rw motor rotor";
/// Words of quantities that are related to an acceleration.
const NO_FORCE_WORDS: &str =
    "bias offset cov covariance std stddev var variance angular setpoint desired target cmd command error noise";
/// Words beside a unit that make it another one.
const MODIFIERS: &str = "centi deci micro nano kilo per min minute h hr hour day s ms us s2 sq squared 2s ns ss";
/// Parts of words that look like a unit of angular velocity, and words that look like a unit of time.
const LIKE_RATE: &str = "deg rad dps rpm rps grad gon lsb hz counts arcsec °";
const LIKE_TIME: &str = "min mins minute minutes h hr hrs hour hours days tick ticks cycles frames samples jiffies ds";
/// Words in brackets that describe a column.
const DESCRIPTIONS: &str = "calibrated uncalibrated filtered body frame sensor imu gyroscope corrected";

/// Returns true if a list of words has a word.
fn listed(list: &str, word: &str) -> bool {
    list.split_whitespace().any(|own| own == word)
}

/// The unit in a name.
#[derive(Debug, Clone, PartialEq)]
enum Claim<U> {
    Absent,
    Known(U),
    /// The text that looks like a unit.
    Unknown(String),
}

/// Replaces the index of a name that is set below or above the line.
fn plain(letter: char) -> char {
    match letter {
        'ₓ' | 'ˣ' => 'x',
        'ᵧ' | 'ʸ' => 'y',
        'ᶻ' => 'z',
        '₀'..='₃' => char::from(b'0' + (u32::from(letter) - u32::from('₀')) as u8),
        letter => letter,
    }
}

/// Returns the words of a name in lower case; a word also begins at a capital, as in `TimeUS` and `IMUGyroX`.
fn words(name: &str) -> Vec<String> {
    let letters: Vec<char> = name.chars().map(plain).collect();
    let mut words = vec![String::new()];
    for (at, letter) in letters.iter().enumerate() {
        let before = at.checked_sub(1).map(|at| letters[at]);
        let after = letters.get(at + 1).is_some_and(|letter| letter.is_lowercase());
        let begins = letter.is_uppercase()
            && before.is_some_and(|before| before.is_lowercase() || (before.is_uppercase() && after));
        let part = letter.is_alphanumeric() || "°º˚".contains(*letter);
        if begins || !part {
            words.push(String::new());
        }
        if part {
            words.last_mut().expect("it begins with one").extend(letter.to_lowercase());
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

/// Returns a name with the text of brackets that hold an index or an axis, and the texts of all others.
fn brackets(name: &str) -> (String, Vec<String>) {
    let (mut plain, mut texts, mut rest) = (String::new(), Vec::new(), name);
    while let Some(open) = rest.find(['(', '[', '{']) {
        let inner = &rest[open + 1..];
        let close = inner.find([')', ']', '}']).unwrap_or(inner.len());
        plain.push_str(&rest[..open]);
        let text = inner[..close].trim();
        if text.chars().all(|letter| letter.is_ascii_digit()) || axis_of(&text.to_lowercase()).is_some() {
            plain.push_str(&format!(" {text} "));
        } else {
            texts.push(text.to_owned());
            plain.push(' ');
        }
        rest = inner.get(close + 1..).unwrap_or_default();
    }
    (plain + rest, texts)
}

/// Returns the unit in a name, and the other words.
fn split<U>(name: &str, parse: fn(&str) -> Option<U>, is_like: fn(&str) -> bool) -> (Claim<U>, Vec<String>) {
    let (plain, texts) = brackets(name);
    let mut words = words(&plain);
    if let Some(unit) = texts.iter().find_map(|text| parse(text)) {
        return (Claim::Known(unit), words);
    }
    let describes = |text: &&String| text.split_whitespace().any(|word| listed(DESCRIPTIONS, &word.to_lowercase()));
    if let Some(text) = texts.iter().find(|text| !describes(text)) {
        return (Claim::Unknown(text.clone()), words);
    }
    for length in (1..=4.min(words.len())).rev() {
        for at in (0..=words.len() - length).rev() {
            // A letter is an axis, a digit an index.
            if length > 1 && words[at].len() == 1 {
                continue;
            }
            let run = words[at..at + length].iter();
            let text: String = run.map(|word| if word.parse::<u32>().is_ok() { "-" } else { word.as_str() }).collect();
            let Some(unit) = parse(&text).filter(|_| !text.contains('-')) else { continue };
            let beside = [at.checked_sub(1).map(|at| &words[at]), words.get(at + length)];
            // As in `deg_s_100`; a smaller number is an index.
            let factor = |word: &String| word.parse::<u32>().is_ok_and(|number| number > 9);
            let modified = |word: &String| listed(MODIFIERS, word) || factor(word);
            if beside.into_iter().flatten().any(modified) || plain.contains(['^', '²']) {
                return (Claim::Unknown(words[at.saturating_sub(1)..].join(" ")), words);
            }
            words.drain(at..at + length);
            return (Claim::Known(unit), words);
        }
    }
    // As in `wx spins/min` and `Gyro X ?/s`.
    let last = plain.split([' ', ',']).next_back().unwrap_or_default();
    let per = last.rsplit_once('/').map_or("", |(_, per)| per);
    if ["s", "sec", "second", "min", "minute", "h", "hr", "hour", "ms"].contains(&per.to_lowercase().as_str()) {
        return (Claim::Unknown(last.to_owned()), words);
    }
    match words.iter().find(|word| is_like(word)) {
        Some(word) => (Claim::Unknown(word.clone()), words.clone()),
        None => (Claim::Absent, words),
    }
}

fn time_claim(name: &str) -> (Claim<TimeUnit>, Vec<String>) {
    let (claim, words) = split(name, TimeUnit::parse, |word| listed(LIKE_TIME, word));
    // As in `timems`.
    let glued = |word: &String| {
        let rest = ["timestamp", "time", "t"].iter().find_map(|stem| word.strip_prefix(stem))?;
        TimeUnit::parse(rest).filter(|_| rest != "s")
    };
    match (&claim, words.len(), words.first().and_then(glued)) {
        (Claim::Absent, 1, Some(unit)) => (Claim::Known(unit), vec!["time".to_owned()]),
        _ => (claim, words),
    }
}

fn rate_claim(name: &str) -> (Claim<RateUnit>, Vec<String>) {
    split(name, RateUnit::parse, |word| LIKE_RATE.split(' ').any(|part| word.contains(part)))
}

/// Returns how well a name is that of a time stamp; 0 is best.
fn stamp_rank(name: &str) -> Option<usize> {
    let (claim, words) = time_claim(name);
    let stem = words.concat();
    let known = |rank: &usize| {
        stem.is_empty() && *rank == 2 || listed(STAMPS[*rank], &stem) || (*rank == 0 && stem.ends_with("headerstamp"))
    };
    if stem.is_empty() && (claim == Claim::Absent || name.trim().len() < 2) {
        return None;
    }
    (0..STAMPS.len()).find(known).or_else(|| {
        let has = |list: &str| words.iter().any(|word| listed(list, word));
        let by_word = (has(STAMP_WORDS) && !has(NO_STAMP_WORDS)).then_some(STAMPS.len());
        // Beside a time of day it has none.
        by_word.or((stem == "date").then_some(STAMPS.len() + 1))
    })
}

/// The axis in a name.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Axis {
    Letter(usize),
    /// An index, from 0 or from 1.
    Number(usize),
}

/// Returns the axis, 0 to 2, that a word names.
fn axis_of(word: &str) -> Option<usize> {
    [["x", "roll"], ["y", "pitch"], ["z", "yaw"]].iter().position(|names| names.contains(&word))
}

/// The name of an angular velocity.
#[derive(Debug, Clone, PartialEq)]
struct RateName {
    /// The rank of its likelihood; 0 is best.
    rank: usize,
    /// The name without axis and unit.
    stem: String,
    axis: Axis,
}

/// Takes the axis out of the words of a name; the second value is true for roll, pitch and yaw. Where the axis begins or ends a word, as
/// in `wx`, `xgyro` and `omega1`, `is_stem` tells if it may be left out.
fn take_axis(words: &mut Vec<String>, is_stem: impl Fn(&str, &str) -> bool) -> Option<(Axis, bool)> {
    let digit = |word: &str| word.parse::<usize>().ok().filter(|digit| word.len() == 1 && *digit < 4);
    if let Some((at, axis)) = (0..words.len()).rev().find_map(|at| Some((at, axis_of(&words[at])?))) {
        return Some((Axis::Letter(axis), words.remove(at).len() > 1));
    }
    let last = words.pop()?;
    if let Some(index) = digit(&last) {
        return Some((Axis::Number(index), false));
    }
    let before = words.concat();
    let parts = ["x", "y", "z", "roll", "pitch", "yaw", "0", "1", "2", "3"].iter().flat_map(|part| {
        let rests = [last.strip_suffix(part), last.strip_prefix(part).filter(|_| digit(part).is_none())];
        rests.into_iter().flatten().map(move |rest| (*part, rest))
    });
    let mut found = parts.map(|(part, rest)| (part, before.clone() + rest));
    let (part, stem) = found.find(|(part, stem)| is_stem(part, stem))?;
    *words = vec![stem];
    let axis = digit(part).map(Axis::Number).or_else(|| axis_of(part).map(Axis::Letter))?;
    Some((axis, part.len() > 2))
}

/// Takes a name for that of an acceleration, best with gravity in it.
fn force_name(name: &str) -> Option<RateName> {
    let mut words = words(&brackets(name).0);
    while words.last().is_some_and(|word| listed("g mg m s s2 ss mss ms2 mps2", word) && words.len() > 1) {
        words.pop();
    }
    let is_force = |word: &str| word == "a" || (word.contains("acc") && !word.contains("accur"));
    let (axis, turn) = take_axis(&mut words, |_, stem| is_force(stem))?;
    let related = |word: &String| listed(NO_FORCE_WORDS, word);
    if turn || words.iter().any(related) || !words.iter().any(|word| is_force(word)) {
        return None;
    }
    let rank = usize::from(words.iter().any(|word| listed("linear lin user", word)));
    Some(RateName { rank, stem: words.concat(), axis })
}

/// Takes a name for that of an angular velocity. `gyro` is true if the file's name says that it has nothing else.
fn rate_name(name: &str, gyro: bool) -> Option<RateName> {
    let (claim, mut words) = rate_claim(name);
    if words.iter().any(|word| listed(NO_RATE_WORDS, word)) {
        return None;
    }
    // As aircraft have them.
    if let ([word], false) = (&words[..], matches!(claim, Claim::Unknown(_)))
        && let Some(axis) = ["p", "q", "r"].iter().position(|letter| letter == word)
    {
        return Some(RateName { rank: 3, stem: "pqr".to_owned(), axis: Axis::Letter(axis) });
    }
    let (axis, turn) = take_axis(&mut words, |part, stem| {
        listed(RATES, stem)
            || RATE_PARTS.split(' ').any(|part| stem.contains(part))
            || (part.len() > 2 && stem == "speed")
    })?;
    words.retain(|word| word != "xyz" && word != "axis");
    let stem = words.concat();
    let part = RATE_PARTS.split(' ').any(|part| stem.contains(part));
    // An angle would have no time in its unit.
    let lower = name.to_lowercase();
    let per_second = ["/s", "ps", "s-1", "s^-1", "sec"].iter().any(|part| lower.contains(part) && !stem.contains(part));
    let is_rate = per_second && matches!(claim, Claim::Known(_)) && !turn;
    let rank = if listed(RATES, &stem) || (turn && stem == "speed") {
        0
    } else if part || words.iter().any(|word| listed(RATE_WORDS, word)) {
        1
    } else if stem.is_empty() && !turn && (gyro || is_rate) {
        2
    } else if is_rate {
        4
    } else {
        return None;
    };
    Some(RateName { rank, stem, axis })
}

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
