//! Random texts, bytes and overrides: the parser returns a scenario or a message, and never panics.

use super::{FILE, keys};
use corotate::config::SHIPPED;
use corotate::scenario::Scenario;
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::test_runner::RngSeed;

/// One random change of a text.
#[derive(Debug, Clone)]
enum Slip {
    DeleteLine(Index),
    RepeatLine(Index, Index),
    ReplaceLine(Index, String),
    ReplaceByte(Index, u8),
    ReplaceNumber(Index, &'static str),
    Cut(Index),
}

impl Slip {
    fn spoil(&self, text: &str) -> String {
        let mut lines: Vec<&str> = text.lines().collect();
        if lines.is_empty() {
            return String::new();
        }
        match self {
            Self::DeleteLine(at) => {
                lines.remove(at.index(lines.len()));
            }
            Self::RepeatLine(from, to) => lines.insert(to.index(lines.len()), lines[from.index(lines.len())]),
            Self::ReplaceLine(at, line) => {
                let at = at.index(lines.len());
                lines[at] = line;
            }
            Self::ReplaceByte(at, byte) => {
                let mut bytes = text.as_bytes().to_vec();
                bytes[at.index(text.len())] = *byte;
                return String::from_utf8_lossy(&bytes).into_owned();
            }
            Self::ReplaceNumber(at, number) => return replace_number(text, at, number),
            Self::Cut(at) => return String::from_utf8_lossy(&text.as_bytes()[..at.index(text.len())]).into_owned(),
        }
        lines.join("\n")
    }
}

/// Returns the text with one of the numbers after ` = ` or in a list replaced.
fn replace_number(text: &str, at: &Index, number: &str) -> String {
    let begins = |(offset, c): &(usize, char)| c.is_ascii_digit() && text[..*offset].ends_with([' ', '[', '-']);
    let begin: Vec<usize> = text.char_indices().filter(begins).map(|(offset, _)| offset).collect();
    if begin.is_empty() {
        return text.to_owned();
    }
    let (before, rest) = text.split_at(begin[at.index(begin.len())]);
    let after = rest.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.' || c == 'e' || c == '-');
    format!("{before}{number}{after}")
}

fn number() -> impl Strategy<Value = &'static str> {
    let numbers = "0 -1 1 2 3 1e3 1e-3 1e9 1e308 1e-320 1e400 nan inf -inf 0x7fff 1_000 9223372036854775807 \
                   -9223372036854775808 18446744073709551615 99999999999999999999";
    let not_numbers = "\"1\" true [] [[]] {} 1979-05-27 ' ,";
    select(numbers.split(' ').chain(not_numbers.split(' ')).collect::<Vec<_>>())
}

fn slip() -> impl Strategy<Value = Slip> {
    prop_oneof![
        1 => any::<Index>().prop_map(Slip::DeleteLine),
        1 => any::<(Index, Index)>().prop_map(|(from, to)| Slip::RepeatLine(from, to)),
        1 => (any::<Index>(), "\\PC{0,30}").prop_map(|(at, line)| Slip::ReplaceLine(at, line)),
        1 => any::<(Index, u8)>().prop_map(|(at, byte)| Slip::ReplaceByte(at, byte)),
        3 => (any::<Index>(), number()).prop_map(|(at, number)| Slip::ReplaceNumber(at, number)),
        1 => any::<Index>().prop_map(Slip::Cut),
    ]
}

/// Returns overrides of existing keys, of unknown keys, and unreadable ones.
fn argument() -> impl Strategy<Value = String> {
    let key = prop_oneof![
        select(keys()),
        select(vec!["leader", "follower", "follower.0", "accept.missed_ticks_max"]).prop_map(str::to_owned),
        "[a-z_.\\[\\]0-9]{0,12}",
    ];
    let value = prop_oneof![number().prop_map(str::to_owned), "\\PC{0,10}", "\\[[0-9., -]{0,12}\\]"];
    prop_oneof![9 => (key, value).prop_map(|(key, value)| format!("{key}={value}")), 1 => any::<String>()]
}

/// Returns the shipped texts with random changes, sometimes none, so that overrides alone are wrong.
fn spoilt() -> impl Strategy<Value = String> {
    let text = select(SHIPPED.map(|(_, text)| text).to_vec());
    (text, prop::collection::vec(slip(), 0..4))
        .prop_map(|(text, slips)| slips.iter().fold(text.to_owned(), |text, slip| slip.spoil(&text)))
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 200,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(0x0bad_f11e),
        ..ProptestConfig::default()
    })]

    #[test]
    fn any_text_with_any_overrides_gives_a_scenario_or_a_message(
        text in spoilt(),
        overrides in prop::collection::vec(argument(), 0..3),
    ) {
        match Scenario::parse(&text, FILE, &overrides) {
            Ok(scenario) => {
                let resolved = scenario.to_toml();
                prop_assert_eq!(Scenario::parse(&resolved, FILE, &[]).unwrap().to_toml(), resolved);
            }
            Err(error) => {
                let message = error.to_string();
                prop_assert!(!message.is_empty());
                for line in message.lines() {
                    prop_assert!(line.starts_with(FILE) || line.starts_with("--set "), "{}", line);
                    prop_assert!(line.len() < 5000 && !line.contains(char::is_control), "{}", line);
                }
            }
        }
    }

    #[test]
    fn any_bytes_give_a_message(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let message = Scenario::parse(&String::from_utf8_lossy(&bytes), FILE, &[]).unwrap_err().to_string();
        prop_assert!(message.starts_with(FILE), "{}", message);
    }
}
