//! The content of a page: sections of text, tables and figures. Must not know HTML.

use super::chart::Picture;
use crate::config::RunId;

/// The content of a page.
#[derive(Debug)]
pub struct Model {
    /// The name of the scenario, campaign or log.
    pub title: String,
    /// The identifier of the run, if it is known.
    pub run: Option<RunId>,
    /// The clock, rate, date and version of the run.
    pub subtitle: String,
    /// The verdict in words, and true if it is good; `None` if the run was not judged. An empty text hides the verdict.
    pub verdict: (String, Option<bool>),
    /// Remarks below the heading.
    pub remarks: Vec<String>,
    /// The SVG definitions of the marks that all charts over time use.
    pub marks: String,
    /// The sections in their order.
    pub sections: Vec<Section>,
}

/// A section with a heading.
#[derive(Debug)]
pub struct Section {
    /// The element id, the target of links.
    pub id: &'static str,
    /// The heading.
    pub title: &'static str,
    /// The content.
    pub blocks: Vec<Block>,
}

/// A block of a section.
#[derive(Debug)]
pub enum Block {
    /// A paragraph; its line breaks are kept.
    Text(String),
    /// A table. Columns of numbers are aligned right; a cell between backticks is a command.
    Table {
        /// The caption; empty if the heading suffices.
        caption: String,
        /// The names of the columns.
        head: Vec<String>,
        /// The rows.
        rows: Vec<Vec<String>>,
    },
    /// Charts with their captions, side by side where they fit.
    Figures(Vec<(Picture, String)>),
    /// The key of a strip: a label for each shade.
    Scale(Vec<String>),
    /// A summary and a text that unfolds below it.
    Details(String, String),
}

impl Block {
    /// Returns a table.
    pub fn table<H: Into<String>>(caption: &str, head: Vec<H>, rows: Vec<Vec<String>>) -> Self {
        Self::Table { caption: caption.to_owned(), head: head.into_iter().map(H::into).collect(), rows }
    }
}

/// Returns the section with the charts of latencies and the table of their percentiles.
pub fn latency_section(latencies: Vec<(String, String, Picture)>, percentiles: Block) -> Section {
    let figures = latencies.into_iter().map(|(stage, what, picture)| (picture, format!("{stage}: {what}"))).collect();
    let text = "Every measured value is counted. A curve ends at the largest value.".to_owned();
    let blocks = vec![Block::Text(text), Block::Figures(figures), percentiles];
    Section { id: "latency", title: "Latency", blocks }
}
