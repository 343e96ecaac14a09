//! Writes a page as HTML that is also well-formed XML, with its style and script inside.
//!
//! The script adds a cursor and zoom to charts over time; without it the page is complete. Must not refer to any address.

use super::chart::Picture;
use super::html::escape;
use super::model::{Block, Model, Section};
use crate::launch::GENERATOR;
use std::fmt::Write;

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// Writes the page.
pub fn page(model: &Model) -> String {
    let mut html = String::from("<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n");
    let title = [&*model.title, &model.verdict.0].into_iter().filter(|part| !part.is_empty()).map(escape);
    let title = title.collect::<Vec<_>>().join(": ");
    let run = model.run.map_or(String::new(), |run| format!(", {}", run.comment()));
    // Writing to a string cannot fail.
    let _ = write!(
        html,
        "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n{GENERATOR}{run}\"/>\n<title>{title}</title>\n<style>\n{STYLE}</style>\n\
         </head>\n<body>\n{}\n<main>\n",
        model.marks
    );
    header(model, &mut html);
    model.sections.iter().for_each(|part| section(part, &mut html));
    let _ = write!(html, "</main>\n<script>/*<![CDATA[*/\n{SCRIPT}/*]]>*/</script>\n</body>\n</html>\n");
    html
}

/// Returns the name and standalone SVG of every figure, in the colours of a white page.
pub fn figures(model: &Model) -> Vec<(String, String)> {
    let style = plain_style();
    let blocks = model.sections.iter().flat_map(|section| &section.blocks);
    let pictures =
        blocks.filter_map(|block| if let Block::Figures(figures) = block { Some(figures) } else { None }).flatten();
    let standalone = |(index, (picture, _)): (usize, &(Picture, String))| {
        let letters = picture.title.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '-' });
        let name = letters.collect::<String>().split('-').filter(|word| !word.is_empty()).collect::<Vec<_>>().join("-");
        let svg = picture.alone().replacen("<svg ", "<svg xmlns=\"http://www.w3.org/2000/svg\" ", 1);
        let inside = svg.find('>').map_or(0, |end| end + 1);
        let svg = format!("{}<style>{style}</style>{}{}", &svg[..inside], model.marks, &svg[inside..]);
        (format!("{:02}-{}", index + 1, name.to_lowercase()), svg)
    };
    pictures.enumerate().map(standalone).collect()
}

/// Returns the style of charts with colours in place of variables, which many SVG programs do not support.
fn plain_style() -> String {
    let (light, rest) = STYLE.split_once('}').unwrap_or_default();
    let colours = light.split("--").skip(1).filter_map(|entry| entry.split_once(':'));
    let colours: Vec<(&str, &str)> =
        colours.map(|(name, value)| (name.trim(), value.trim().trim_end_matches(';').trim())).collect();
    let from = rest.find(PICTURES).unwrap_or(0);
    let pictures = rest[from..].split("@media").next().unwrap_or_default();
    colours.iter().fold(pictures.to_owned(), |style, (name, value)| style.replace(&format!("var(--{name})"), value))
}

/// The comment at which the style of charts begins.
const PICTURES: &str = "/* Pictures. */";

fn header(model: &Model, html: &mut String) {
    let (word, good) = &model.verdict;
    let (class, sign) = match good {
        Some(true) => ("good", "✓ "),
        Some(false) => ("bad", "✗ "),
        None => ("open", ""),
    };
    let (title, subtitle, word) = (escape(&model.title), escape(&model.subtitle), escape(word));
    let badge = format!(" <span class=\"verdict {class}\">{sign}{word}</span>");
    let badge = if word.is_empty() { "" } else { &badge };
    let _ = write!(html, "<header>\n<h1>{title}{badge}</h1>\n<p>{subtitle}</p>\n");
    for remark in &model.remarks {
        let _ = writeln!(html, "<p class=\"remark\">{}</p>", escape(remark));
    }
    html.push_str("<nav>");
    for part in &model.sections {
        let _ = write!(html, "<a href=\"#{}\">{}</a> ", part.id, escape(part.title));
    }
    html.push_str("</nav>\n</header>\n");
}

fn section(section: &Section, html: &mut String) {
    let _ = writeln!(html, "<section id=\"{}\">\n<h2>{}</h2>", section.id, escape(section.title));
    section.blocks.iter().for_each(|part| block(part, html));
    html.push_str("</section>\n");
}

fn block(block: &Block, html: &mut String) {
    match block {
        Block::Text(text) => {
            let _ = writeln!(html, "<p>{}</p>", escape(text).replace('\n', "<br/>\n"));
        }
        Block::Table { caption, head, rows } if !rows.is_empty() => table(caption, head, rows, html),
        Block::Table { .. } => {}
        Block::Figures(figures) => {
            let wide = if figures.iter().all(|(picture, _)| picture.is_wide()) { " wide" } else { "" };
            let shared = shares_legend(figures);
            if shared {
                html.push_str("<p class=\"scale\">");
                legend(&figures[0].0, html);
                html.push_str("</p>\n");
            }
            let _ = writeln!(html, "<div class=\"figures{wide}\">");
            figures.iter().for_each(|(picture, caption)| figure(picture, caption, !shared, html));
            html.push_str("</div>\n");
        }
        Block::Scale(labels) => {
            html.push_str("<p class=\"scale\">");
            for (index, label) in labels.iter().enumerate() {
                let _ = write!(
                    html,
                    "<span class=\"key\"><svg width=\"16\" height=\"12\"><rect class=\"shade{index}\" width=\"16\" \
                     height=\"12\"/></svg>{}</span> ",
                    escape(label)
                );
            }
            html.push_str("</p>\n");
        }
        Block::Details(summary, text) => {
            let (summary, text) = (escape(summary), escape(text));
            let _ = writeln!(html, "<details><summary>{summary}</summary>\n<pre>{text}</pre></details>");
        }
    }
}

/// Escapes a name and allows line breaks after `/` and `_` only.
fn breakable(text: &str) -> String {
    escape(text).replace('/', "/<wbr/>").replace('_', "_<wbr/>")
}

fn table(caption: &str, head: &[String], rows: &[Vec<String>], html: &mut String) {
    html.push_str("<div class=\"table\"><table>\n");
    if !caption.is_empty() {
        let _ = writeln!(html, "<caption>{}</caption>", escape(caption));
    }
    // A column of numbers only is aligned right.
    let numeric = |column: usize| {
        let cells = || rows.iter().filter_map(|row| row.get(column)).filter(|cell| *cell != "–");
        cells().next().is_some() && cells().all(|cell| cell.parse::<f64>().is_ok())
    };
    let classes: Vec<&str> = (0..head.len()).map(|column| if numeric(column) { " class=\"n\"" } else { "" }).collect();
    html.push_str("<thead><tr>");
    for (name, class) in head.iter().zip(&classes) {
        let _ = write!(html, "<th{class}>{}</th>", breakable(name));
    }
    html.push_str("</tr></thead>\n<tbody>\n");
    for row in rows {
        html.push_str("<tr>");
        for (cell, class) in row.iter().zip(&classes) {
            let command = cell.strip_prefix('`').and_then(|cell| cell.strip_suffix('`'));
            let content =
                command.map_or_else(|| breakable(cell), |command| format!("<code>{}</code>", escape(command)));
            let _ = write!(html, "<td{class}>{content}</td>");
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody></table></div>\n");
}

/// Returns true if all figures of a block have the same legend, and they are so many that it is written once above them.
fn shares_legend(figures: &[(Picture, String)]) -> bool {
    const MANY: usize = 4;
    let equal = |pair: &[(Picture, String)]| pair[0].0.legend == pair[1].0.legend;
    figures.len() > MANY && figures.windows(2).all(equal) && !figures[0].0.legend.is_empty()
}

fn legend(picture: &Picture, html: &mut String) {
    for (class, label) in &picture.legend {
        let _ = write!(
            html,
            "<span class=\"key\"><svg width=\"34\" height=\"10\"><path class=\"line {class}\" d=\"M1 5H33\"/></svg>{}</span> ",
            escape(label)
        );
    }
}

fn figure(picture: &Picture, caption: &str, with_legend: bool, html: &mut String) {
    html.push_str("<figure>\n");
    let _ = match &picture.narrow {
        None => write!(html, "{}\n<figcaption>", picture.svg),
        Some(narrow) => {
            write!(
                html,
                "<div class=\"broad\">{}</div>\n<div class=\"narrow\">{narrow}</div>\n<figcaption>",
                picture.svg
            )
        }
    };
    if with_legend {
        legend(picture, html);
    }
    let _ = writeln!(html, "<span class=\"caption\">{}</span></figcaption>\n</figure>", escape(caption));
}
