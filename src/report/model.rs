//! What a page is made of: sections of facts, tables and figures. Must not know how a page is written.

use super::chart::Picture;
use crate::config::RunId;

/// A page.
#[derive(Debug)]
pub struct Model {
    /// What it is of.
    pub title: String,
    /// The run, if it is known.
    pub run: Option<RunId>,
    /// When and how that was made.
    pub subtitle: String,
    /// The verdict in a word, and whether it is a good one; none where nothing was judged. Empty where there is nothing to judge.
    pub verdict: (String, Option<bool>),
    /// What a reader must know before all else.
    pub remarks: Vec<String>,
    /// The marks that all pictures over time use.
    pub marks: String,
    /// What is shown.
    pub sections: Vec<Section>,
}

/// A part with a heading.
#[derive(Debug)]
pub struct Section {
    /// What links name it by.
    pub id: &'static str,
    /// Its heading.
    pub title: &'static str,
    /// Its content.
    pub blocks: Vec<Block>,
}

/// A piece of a section.
#[derive(Debug)]
pub enum Block {
    /// A paragraph, with the breaks of its lines.
    Text(String),
    /// Rows under a head. Cells that are numbers stand to the right; one between backticks is a command.
    Table {
        /// What it is, if the heading does not say.
        caption: String,
        /// The names of its columns.
        head: Vec<String>,
        /// The rows.
        rows: Vec<Vec<String>>,
    },
    /// Pictures beside each other as far as there is room, each with its caption.
    Figures(Vec<(Picture, String)>),
    /// The shades of a strip and what they mean.
    Scale(Vec<String>),
    /// A text to be opened.
    Details(String, String),
}

impl Block {
    /// A table.
    pub fn table<H: Into<String>>(caption: &str, head: Vec<H>, rows: Vec<Vec<String>>) -> Self {
        Self::Table { caption: caption.to_owned(), head: head.into_iter().map(H::into).collect(), rows }
    }
}

/// Distributions of latencies, and their figures.
pub fn latency_section(latencies: Vec<(String, String, Picture)>, figures_of: Block) -> Section {
    let figures = latencies.into_iter().map(|(stage, what, picture)| (picture, format!("{stage}: {what}"))).collect();
    let text = "Every value is counted, none is removed; the end of a curve is its largest value.".to_owned();
    let blocks = vec![Block::Text(text), Block::Figures(figures), figures_of];
    Section { id: "latency", title: "Latency", blocks }
}
