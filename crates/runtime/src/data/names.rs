//! Understands the name of one column: its quantity, its axis and its unit.

use super::unit::{RateUnit, TimeUnit};

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
pub(super) enum Claim<U> {
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
pub(super) fn words(name: &str) -> Vec<String> {
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

/// Returns the unit of time in a name, and the other words.
pub(super) fn time_claim(name: &str) -> (Claim<TimeUnit>, Vec<String>) {
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

/// Returns the unit of angular velocity in a name, and the other words.
pub(super) fn rate_claim(name: &str) -> (Claim<RateUnit>, Vec<String>) {
    split(name, RateUnit::parse, |word| LIKE_RATE.split(' ').any(|part| word.contains(part)))
}

/// Returns how well a name is that of a time stamp; 0 is best.
pub(super) fn stamp_rank(name: &str) -> Option<usize> {
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
pub(super) enum Axis {
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
pub(super) struct RateName {
    /// The rank of its likelihood; 0 is best.
    pub rank: usize,
    /// The name without axis and unit.
    pub stem: String,
    pub axis: Axis,
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
pub(super) fn force_name(name: &str) -> Option<RateName> {
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
pub(super) fn rate_name(name: &str, gyro: bool) -> Option<RateName> {
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
