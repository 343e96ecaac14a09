//! Escaping of text: text from a file never becomes markup.

/// Escapes a text for markup and attributes. Replaces characters that XML forbids and control characters.
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
    fn a_parser_restores_the_escaped_text() {
        let text = "<script>alert('\"&amp;')</script> ω é\n";
        let page = format!("<p title=\"{}\">{}</p>", escape(text).replace('\n', "&#10;"), escape(text));
        let document = roxmltree::Document::parse(&page).unwrap();
        assert_eq!(document.root_element().text(), Some(text));
        assert_eq!(document.root_element().attribute("title"), Some(text));
        assert_eq!(escape("\u{1b}\0\u{ffff}\u{7f}\u{9b}"), "\u{fffd}".repeat(5));
    }
}
