//! Finds the table in a text: its separator, the lines of its header, and its first row. Must not interpret a number.

use super::stamp::Stamp;
use csv::{ReaderBuilder, Trim};

/// The separators, the most certain first.
const SEPARATORS: [u8; 5] = [b'\t', b';', b'|', b',', b' '];
/// The number of lines by which a separator is chosen.
const LINES: usize = 200;
/// Texts that begin a comment.
pub const COMMENTS: [&str; 3] = ["#", "%", "//"];
/// Cells without a value.
const UNKNOWN: [&str; 11] = ["", "-", "--", "NA", "N/A", "na", "n/a", "null", "NULL", "None", "nan"];

/// The form of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    pub separator: u8,
    /// The number of lines before the first row.
    pub lines: u64,
    /// The possible headers, the most likely first: the line, and the names.
    pub headers: Vec<(u64, Vec<String>)>,
    /// The cells of the first row.
    pub first: Vec<String>,
}

/// A line with its number, from 1.
struct Line<'a> {
    number: u64,
    text: &'a str,
}

impl Line<'_> {
    /// Returns the text of a comment.
    fn comment(&self) -> Option<&str> {
        let text = self.text.trim_start();
        let marks = COMMENTS.iter().find_map(|mark| text.strip_prefix(mark));
        marks.map(|rest| rest.trim_start_matches(['#', '%', '/']))
    }
}

/// Returns true if the cell has no value.
pub fn is_unknown(cell: &str) -> bool {
    UNKNOWN.contains(&cell)
}

/// Reads a number; with `comma` it may have a decimal comma.
pub fn number(cell: &str, comma: bool) -> Option<f64> {
    cell.parse().ok().or_else(|| cell.replacen(',', ".", 1).parse().ok().filter(|_| comma && is_decimal_comma(cell)))
}

/// Returns true if a cell is a number with a decimal comma.
pub fn is_decimal_comma(cell: &str) -> bool {
    let digit = |letter: Option<char>| letter.is_some_and(|letter| letter.is_ascii_digit());
    let whole = cell.split_once(',').filter(|(_, part)| digit(part.chars().next()));
    whole.is_some_and(|_| cell.replacen(',', ".", 1).parse::<f64>().is_ok())
}

/// Returns true if commas group the digits of the rows: three follow each, and smaller numbers in the same column have none.
pub fn groups_digits<'a>(rows: impl Iterator<Item = &'a str>, separator: u8) -> bool {
    let mut columns: Vec<[bool; 2]> = Vec::new();
    for row in rows {
        for (column, cell) in cells(row, separator).iter().enumerate().filter(|(_, cell)| number(cell, true).is_some())
        {
            columns.resize(columns.len().max(column + 1), [false; 2]);
            let group = cell.split_once(',').map(|(whole, part)| {
                let digits = whole.trim_start_matches(['-', '+']);
                part.len() == 3 && (1..=3).contains(&digits.len()) && !digits.starts_with('0')
            });
            match group {
                Some(false) => return false,
                Some(true) => columns[column][0] = true,
                None => columns[column][1] = true,
            }
        }
    }
    columns.contains(&[true; 2])
}

/// Returns the cells of a line. Only quotes need the reader of CSV, whose construction takes far longer than a line.
pub fn cells(line: &str, separator: u8) -> Vec<String> {
    match (line.contains('"'), separator) {
        (false, b' ') => line.split_whitespace().map(str::to_owned).collect(),
        (false, _) => line.split(char::from(separator)).map(|cell| cell.trim().to_owned()).collect(),
        (true, b' ') => quoted(&line.split_whitespace().collect::<Vec<_>>().join(" "), separator),
        (true, _) => quoted(line, separator),
    }
}

fn quoted(line: &str, separator: u8) -> Vec<String> {
    let mut builder = ReaderBuilder::new();
    builder.delimiter(separator).trim(Trim::All).has_headers(false).flexible(true).buffer_capacity(256);
    let record = builder.from_reader(line.as_bytes()).into_records().next();
    record.and_then(Result::ok).map(|record| record.iter().map(str::to_owned).collect()).unwrap_or_default()
}

/// Returns the number of cells with a number or a time of day, if it makes the line a row.
fn row(cells: &[String], separator: u8) -> Option<usize> {
    let is_number = |cell: &&String| number(cell, separator != b',').is_some() || Stamp::clock(cell).is_some();
    let numbers = cells.iter().filter(is_number).count();
    let given = cells.iter().filter(|cell| !is_unknown(cell)).count();
    (numbers >= 2 && 3 * numbers >= given).then_some(numbers)
}

/// Finds the table in the begin of a text.
pub fn find(text: &str) -> Option<Table> {
    let lines: Vec<Line<'_>> = text.lines().zip(1..).map(|(text, number)| Line { number, text }).collect();
    let lines: Vec<Line<'_>> = lines.into_iter().filter(|line| !line.text.trim().is_empty()).collect();
    // The earlier one among equals.
    let best =
        SEPARATORS.iter().rev().filter_map(|separator| begin(&lines, *separator)).max_by_key(|(score, ..)| *score);
    let Some((_, separator, first)) = best else {
        // No row looks like one: whatever follows the first line is read, and refused with its line.
        let header = lines.iter().position(|line| line.comment().is_none())?;
        let line = &lines[header];
        let separator = plain_separator(line.text);
        let names = cells(line.text, separator);
        return Some(Table { separator, lines: line.number, headers: vec![(line.number, names)], first: Vec::new() });
    };
    let row = cells(lines[first].text, separator);
    let headers = headers(&lines[..first], separator, row.len());
    Some(Table { separator, lines: lines[first].number - 1, headers, first: row })
}

/// Returns how much of the text is rows with this separator, and the index of the first one.
fn begin(lines: &[Line<'_>], separator: u8) -> Option<(usize, u8, usize)> {
    let (mut score, mut first, mut last, mut single) = (0, None, None, None);
    for (index, line) in lines.iter().enumerate().filter(|(_, line)| line.comment().is_none()) {
        let cells = cells(line.text, separator);
        let numbers = row(&cells, separator);
        single = single.or(numbers.map(|numbers| (numbers, separator, index)));
        // A line of the preamble is not followed by one of its kind.
        if let (Some(numbers), Some((before, count))) = (numbers, last)
            && (first.is_some() || count == cells.len())
        {
            first = first.or(Some(before));
            score += numbers;
        }
        last = numbers.map(|_| (index, cells.len())).or(last.filter(|_| first.is_some()));
        if score > 0 && index > LINES {
            break;
        }
    }
    first.map(|first| (score, separator, first)).or(single)
}

/// Returns the most frequent separator but the space.
fn plain_separator(line: &str) -> u8 {
    let count = |separator: &u8| line.bytes().filter(|byte| byte == separator).count();
    // Among equal counts, `max_by_key` takes the last.
    SEPARATORS[..4].iter().copied().max_by_key(count).unwrap_or(b',')
}

/// Returns the lines before the first row that may be its header: first those with as many cells.
fn headers(before: &[Line<'_>], separator: u8, count: usize) -> Vec<(u64, Vec<String>)> {
    let mut found = Vec::new();
    let split = |line: &Line<'_>, separator: u8| {
        let text = line.comment().unwrap_or(line.text);
        let mut names = cells(text, separator);
        // A separator at the end of the line.
        while names.len() > count.max(1) && names.last().is_some_and(String::is_empty) {
            names.pop();
        }
        names
    };
    let named = |line: &Line<'_>| split(line, separator);
    for (index, line) in before.iter().enumerate().rev().filter(|(_, line)| named(line).len() == count) {
        let names = named(line);
        found.push((line.number, names.clone()));
        // The names may be above their units, or their group above them.
        if let Some(upper) =
            index.checked_sub(1).map(|above| named(&before[above])).filter(|upper| upper.len() <= count)
        {
            let mut group = String::new();
            let pairs = names.iter().enumerate().map(|(column, name)| {
                match upper.get(column) {
                    Some(above) if !above.is_empty() => group.clone_from(above),
                    _ => {}
                }
                if name.is_empty() { group.clone() } else { format!("{group} {name}") }
            });
            found.push((before[index - 1].number, pairs.collect()));
        }
    }
    // A header may be separated in another way than the rows, such as by two spaces.
    let otherwise = before.iter().rev().filter(|line| named(line).len() != count).filter_map(|line| {
        let text = line.comment().unwrap_or(line.text);
        let apart = text.split("  ").map(|name| name.trim().to_owned()).filter(|name| !name.is_empty()).collect();
        // As in `t [s] wx [rad/s]`.
        let with_units = cells(&text.replace(" [", "[").replace(" (", "("), b' ');
        let names = SEPARATORS
            .iter()
            .map(|separator| split(line, *separator))
            .chain([apart, with_units])
            .find(|names: &Vec<String>| names.len() == count)?;
        Some((line.number, names))
    });
    found.extend(otherwise);
    let shorter = before.iter().rev().filter(|line| line.comment().is_none() && named(line).len() != count);
    found.extend(shorter.map(|line| (line.number, named(line))));
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(text: &str) -> (u8, u64, usize, Vec<String>) {
        let table = find(text).unwrap();
        let names = table.headers.first().map(|(_, names)| names.clone()).unwrap_or_default();
        (table.separator, table.lines, table.first.len(), names)
    }

    #[test]
    fn separators_and_preambles_are_found() {
        for (text, separator, lines) in [
            ("t,wx,wy,wz\n0,1,2,3\n1,1,2,3\n", b',', 1),
            ("t;wx;wy;wz\n0,0;1,5;2;3\n0,1;1,5;2;3\n", b';', 1),
            ("t\twx\twy\twz\n0,0\t1,5\t2\t3\n", b'\t', 1),
            ("t | wx | wy | wz\n0 | 1 | 2 | 3\n1 | 1 | 2 | 3\n", b'|', 1),
            (" t   wx wy\twz\n 0  1,5 2 3\n 1  1,5 2 3\n", b' ', 1),
            ("Device: a phone\nRate, 100, Version, 2\n\n# note\nt,wx,wy,wz\n0,1,2,3\n1,1,2,3\n", b',', 5),
            ("% made by\n// a logger\nt, wx, wy, wz\n0, 1, 2, 3\n1, 1, 2, 3\n", b',', 3),
            ("t,wx,wy,wz,note\n12:00:00.0,1,2,3,a b\n12:00:00.1,1,2,3,c d\n", b',', 1),
        ] {
            let (found, before, cells, names) = found(text);
            assert_eq!((found, before), (separator, lines), "{text}");
            assert_eq!((cells, names.len()), (names.len(), cells), "{text}");
        }
    }

    #[test]
    fn headers_in_comments_and_in_two_lines_are_found() {
        assert_eq!(found("#t [ns],wx,wy,wz\n0,1,2,3\n1,1,2,3\n").3, ["t [ns]", "wx", "wy", "wz"]);
        let two = find("Time (s);IMU;;\n;X;Y;Z\n0;1;2;3\n1;1;2;3\n").unwrap();
        assert!(
            two.headers.contains(&(1, ["Time (s)", "IMU X", "IMU Y", "IMU Z"].map(str::to_owned).to_vec())),
            "{two:?}"
        );
        let units = find("t,wx,wy,wz\ns,dps,dps,dps\n0,1,2,3\n1,1,2,3\n").unwrap();
        assert!(units.headers.contains(&(1, ["t s", "wx dps", "wy dps", "wz dps"].map(str::to_owned).to_vec())));
        assert_eq!(found("0,1,2,3\n1,1,2,3\n").3, [""; 0]);
        for header in ["t wx wy wz", "t;wx;wy;wz", "# t\twx\twy\twz"] {
            assert_eq!(found(&format!("{header}\n0,1,2,3\n1,1,2,3\n")).3, ["t", "wx", "wy", "wz"]);
        }
        let apart = found("#t (s)   wx (rad/s)   wy (rad/s)   wz (rad/s)\n0  1  2  3\n1  1  2  3\n");
        assert_eq!(apart.3, ["t (s)", "wx (rad/s)", "wy (rad/s)", "wz (rad/s)"]);
        let units = found("# a logger\n# t [ms] p [mdps] q [mdps] r [mdps]\n0 1 2 3\n1 1 2 3\n");
        assert_eq!(units.3, ["t[ms]", "p[mdps]", "q[mdps]", "r[mdps]"]);
    }
}
