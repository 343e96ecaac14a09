//! The identifier of a run, common to the files of its directory.
//!
//! Must not generate one: the program that starts the run does.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The text before the identifier in a comment line.
const MARK: &str = "run ";

/// 128 random bits, written as 32 hexadecimal digits. No result depends on them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct RunId(u128);

/// The error for a text that is not a run identifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a run's identifier is 32 hexadecimal digits; take it from its summary.json")]
pub struct NoRunId;

impl RunId {
    /// Creates an identifier from its bits.
    pub fn from_bits(bits: [u8; 16]) -> Self {
        Self(u128::from_le_bytes(bits))
    }

    /// Returns the text of a comment that names the run.
    pub fn comment(self) -> String {
        format!("{MARK}{self}")
    }

    /// Returns the identifier in the first `#` comment of a text that names one.
    pub fn in_comments_of(text: &str) -> Option<Self> {
        let comments = text.lines().filter_map(|line| line.strip_prefix('#'));
        comments
            .filter_map(|line| line.trim_start_matches(['[', ' ']).strip_prefix(MARK)?.get(..32)?.parse().ok())
            .next()
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl FromStr for RunId {
    type Err = NoRunId;

    fn from_str(text: &str) -> Result<Self, NoRunId> {
        let digits = text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        u128::from_str_radix(text, 16).ok().filter(|_| digits).map(Self).ok_or(NoRunId)
    }
}

impl From<RunId> for String {
    fn from(run: RunId) -> Self {
        run.to_string()
    }
}

impl TryFrom<String> for RunId {
    type Error = NoRunId;

    fn try_from(text: String) -> Result<Self, NoRunId> {
        text.parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn an_identifier_is_read_back_from_every_form(bits: [u8; 16], before in "[^#]{0,40}") {
            let run = RunId::from_bits(bits);
            prop_assert_eq!(run.to_string().parse(), Ok(run));
            prop_assert_eq!(serde_json::from_str::<RunId>(&serde_json::to_string(&run).unwrap()).unwrap(), run);
            for form in [format!("# {}\nrest", run.comment()), format!("x\n#[{}]", run.comment())] {
                prop_assert_eq!(RunId::in_comments_of(&form), Some(run));
                prop_assert_eq!(RunId::in_comments_of(&format!("{before}\n{form}")), Some(run));
            }
        }

        #[test]
        fn no_text_makes_it_panic(text in any::<String>()) {
            let _ = RunId::in_comments_of(&text);
            let _ = RunId::in_comments_of(&format!("# run {text}"));
            let _ = text.parse::<RunId>();
        }
    }

    #[test]
    fn an_invalid_identifier_is_refused() {
        for text in ["", "0", "+0000000000000000000000000000000", "0000000000000000000000000000000g"] {
            assert_eq!(text.parse::<RunId>(), Err(NoRunId), "{text}");
        }
        assert_eq!(RunId::in_comments_of("run 00000000000000000000000000000000"), None, "no comment");
    }
}
