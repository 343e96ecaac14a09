//! Text for a page: nothing that comes from a file is ever read as markup.

/// A text as it stands in markup and in its attributes. What XML cannot hold is replaced, and what commands a terminal.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '&' => escaped.push_str("&amp;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            '\t' | '\n' | ' '..='~' | '\u{a0}'..='\u{d7ff}' | '\u{e000}'..='\u{fffd}' | '\u{10000}'.. => {
                escaped.push(letter);
            }
            _ => escaped.push(char::REPLACEMENT_CHARACTER),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_escaped_reads_back_as_it_was() {
        let text = "<script>alert('\"&amp;')</script> ω é\n";
        let page = format!("<p title=\"{}\">{}</p>", escape(text).replace('\n', "&#10;"), escape(text));
        let document = roxmltree::Document::parse(&page).unwrap();
        assert_eq!(document.root_element().text(), Some(text));
        assert_eq!(document.root_element().attribute("title"), Some(text));
        assert_eq!(escape("\u{1b}\0\u{ffff}\u{7f}\u{9b}"), "\u{fffd}".repeat(5));
    }
}
