//! Bad input gives exit code 2 and one clear message with place, key, reason and remedy; nothing is started and nothing
//! is left. The parser answers to any text and never panics.
//!
//! Most cases change one line of the shipped scenario rigid-pair; the expected line number is found in the changed
//! text.

mod commands;
mod random;
mod text;
mod values;

use crate::common::{Bench, Done, code_of};
use std::path::PathBuf;

/// The text that the tests change.
const PAIR: &str = include_str!("../../../config/rigid-pair.toml");
/// Its file name in messages.
const FILE: &str = "bad.toml";

/// A key, an invalid value, and the expected error code.
type Row = (&'static str, &'static str, &'static str);

/// Returns line number (from 1) and path of every key and table of a text in the layout of the shipped ones.
fn paths(text: &str) -> Vec<(usize, String)> {
    let mut found: Vec<(usize, String)> = Vec::new();
    let mut table = String::new();
    for (number, line) in (1..).zip(text.lines()) {
        if let Some((name, _)) = line.strip_prefix("[[").and_then(|rest| rest.split_once("]]")) {
            let of_list = |path: &&(usize, String)| path.1.starts_with(&format!("{name}[")) && path.1.ends_with(']');
            table = format!("{name}[{}]", found.iter().filter(of_list).count());
            found.push((number, table.clone()));
        } else if let Some((name, _)) = line.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            table = name.to_owned();
            found.push((number, table.clone()));
        } else if let Some((key, _)) = line.split_once(" = ").filter(|_| !line.starts_with('#')) {
            found.push((number, if table.is_empty() { key.to_owned() } else { format!("{table}.{key}") }));
        }
    }
    found
}

/// Returns the keys of the text, without its tables.
fn keys() -> Vec<String> {
    let is_key = |number: usize| !line(number).starts_with('[');
    paths(PAIR).into_iter().filter(|(number, _)| is_key(*number)).map(|(_, path)| path).collect()
}

/// Returns a line of the text.
fn line(number: usize) -> &'static str {
    PAIR.lines().nth(number - 1).unwrap()
}

fn line_of(text: &str, key: &str) -> Option<usize> {
    paths(text).into_iter().find(|(_, path)| path == key).map(|(number, _)| number)
}

/// Splits a key into its table and its name there.
fn split(key: &str) -> (Option<&str>, &str) {
    key.rsplit_once('.').map_or((None, key), |(table, name)| (Some(table), name))
}

/// Returns the text with one line replaced by any number of lines.
fn replace(text: &str, number: usize, by: &[&str]) -> String {
    let mut lines: Vec<&str> = text.lines().collect();
    lines.splice(number - 1..number, by.iter().copied());
    lines.join("\n") + "\n"
}

/// Returns the text with one key set to a value, in its place or first in its table.
fn with(text: &str, key: &str, value: &str) -> String {
    let (table, name) = split(key);
    let line = format!("{name} = {value}");
    match (line_of(text, key), table) {
        (Some(number), _) => replace(text, number, &[&line]),
        (None, Some(table)) => {
            let head = line_of(text, table).unwrap();
            replace(text, head, &[text.lines().nth(head - 1).unwrap(), &line])
        }
        (None, None) => format!("{line}\n{text}"),
    }
}

/// Returns the text without a table and its keys; all other lines keep their numbers.
fn without_table(table: &str) -> String {
    let of_table = |path: &str| path == table || path.starts_with(&format!("{table}."));
    let gone: Vec<usize> =
        paths(PAIR).into_iter().filter(|(_, path)| of_table(path)).map(|(number, _)| number).collect();
    let keep = |(number, line)| if gone.contains(&number) { "" } else { line };
    (1..).zip(PAIR.lines()).map(keep).collect::<Vec<_>>().join("\n")
}

/// Returns the place that a message must name for a key: its line, its table's line, or the file.
fn place(text: &str, key: &str) -> String {
    let around = std::iter::successors(Some(key), |key| key.rfind(['.', '[']).map(|end| &key[..end]));
    match around.into_iter().find_map(|key| line_of(text, key)) {
        Some(number) => format!("{FILE}:{number}"),
        None => FILE.to_owned(),
    }
}

/// Returns all paths in a bench's directory and runtime directory.
fn contents(bench: &Bench) -> Vec<PathBuf> {
    let command = bench.command();
    let runtime = command.get_envs().find(|(name, _)| *name == "XDG_RUNTIME_DIR").and_then(|(_, value)| value).unwrap();
    let directories = [bench.path(""), PathBuf::from(runtime)];
    directories.iter().flat_map(|path| std::fs::read_dir(path).unwrap()).map(|entry| entry.unwrap().path()).collect()
}

/// Runs a command that must be refused before anything is started.
fn refused_in(bench: &Bench, arguments: &[&str]) -> Done {
    let before = contents(bench);
    let done = bench.run(arguments);
    assert_eq!(done.code, Some(2), "{done:?}");
    assert!(!done.stderr.is_empty() && !done.stderr.contains("panicked"), "{done:?}");
    // A clear message is short and has no control characters.
    assert!(done.stderr.lines().all(|line| line.len() < 2000 && !line.contains(char::is_control)), "{done:?}");
    assert_eq!(contents(bench), before, "a file was left");
    assert!(bench.processes().is_empty(), "a process still runs");
    done
}

/// Runs a text that must be refused, and returns the lines of the message.
fn refused(text: impl AsRef<[u8]>, arguments: &[&str]) -> Vec<String> {
    let bench = Bench::new();
    std::fs::write(bench.path(FILE), text).unwrap();
    let done = refused_in(&bench, &[&["run", FILE], arguments].concat());
    assert_eq!(done.stdout, "", "{done:?}");
    let (quotes, lines): (Vec<String>, Vec<String>) =
        done.stderr.lines().map(str::to_owned).partition(|line: &String| is_quote(line));
    assert!(lines.iter().all(|line| line.starts_with("corotate: ")), "{lines:?}");
    let placed = lines.iter().filter(|line| line.starts_with(&format!("corotate: {FILE}:"))).count();
    assert!(quotes.len() <= placed, "{quotes:?} of {lines:?}");
    assert!(lines.len() <= 3, "one fault, {} findings: {lines:?}", lines.len());
    lines
}

/// Returns true if a line quotes the file: line number and content.
fn is_quote(line: &str) -> bool {
    let number = line.strip_prefix("corotate: ").and_then(|line| line.split_once(" | "));
    number.is_some_and(|(number, _)| number.trim().parse::<usize>().is_ok())
}

/// Asserts that one of the lines begins with a place and has a code.
fn assert_says(lines: &[String], start: &str, code: &str) {
    let says = |line: &String| line.starts_with(start) && code_of(line) == Some(code);
    assert!(lines.iter().any(says), "expected {start:?} and {code}, got {lines:#?}");
    assert!(lines.iter().all(|line| code_of(line).is_some()), "no code: {lines:#?}");
}

/// Asserts that a text is refused for one key at the right place.
fn assert_refused(text: &str, key: &str, code: &str) {
    assert_says(&refused(text, &[]), &format!("corotate: {}: {key}", place(text, key)), code);
}

/// Asserts that a text is refused for one key, with a suggestion.
fn assert_suggests(text: &str, key: &str, code: &str, meant: &str) {
    let lines = refused(text, &[]);
    assert_says(&lines, &format!("corotate: {}: {key}", place(text, key)), code);
    assert!(lines.iter().any(|line| line.contains(&format!("`{meant}`"))), "{meant}: {lines:#?}");
}

fn assert_all_refused(rows: &[Row]) {
    for (key, value, code) in rows {
        assert_refused(&with(PAIR, key, value), key, code);
    }
}
