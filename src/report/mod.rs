//! A run, or a campaign, as one page that is looked at: pictures and tables in a single file of HTML that needs nothing beside it.
//!
//! | file | duty |
//! |---|---|
//! | `source` | what there is: a run's directory, or a recording alone |
//! | `traces` | one pass over a recording |
//! | `columns` | signals of any length in a bounded number of columns, their extremes kept |
//! | `hidden` | another page: the hidden component of a log |
//! | `counterpart` | the run that an orbit's is compared with |
//! | `percentiles` | latency distributions as curves |
//! | `model` | what a page is made of: sections of facts, tables and figures |
//! | `single` | what is shown of a run, in which order |
//! | `pair` | the same for two runs over each other |
//! | `pictures` | which pictures the samples give |
//! | `tables` | the tables of the summary |
//! | `campaign` | another page: the table of a campaign |
//! | `axis`, `frame`, `chart` | pictures as SVG |
//! | `html`, `page` | the page |
//!
//! Must not judge a run: verdicts are those of its summary. Must not leave out silently: what is missing is said.

mod axis;
mod campaign;
mod chart;
mod columns;
mod counterpart;
mod error;
mod frame;
mod hidden;
mod html;
mod model;
mod page;
mod pair;
mod percentiles;
mod pictures;
mod single;
mod source;
mod tables;
mod traces;

pub use error::ReportError;
pub use hidden::{HiddenFacts, HiddenPage};

use crate::campaign::Table;
use source::Source;
use std::path::Path;

/// A page.
#[derive(Debug)]
pub struct Report {
    html: String,
    figures: Vec<(String, String)>,
    remarks: Vec<String>,
    damaged: bool,
}

impl Report {
    /// Whether its recording is damaged, and shown as far as it can be believed.
    pub fn is_damaged(&self) -> bool {
        self.damaged
    }

    /// The page: HTML that is well-formed XML too.
    pub fn html(&self) -> &str {
        &self.html
    }

    /// What a reader must know before all else: what is missing, and how to get it.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// Its figures, each a picture (SVG) that needs no page: name and text.
    pub fn figures(&self) -> &[(String, String)] {
        &self.figures
    }

    /// Writes every figure to a file of its own in a directory, as SVG.
    ///
    /// # Errors
    /// [`ReportError::Write`].
    pub fn write_figures(&self, directory: &Path) -> Result<(), ReportError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            |source| ReportError::Write { path, source }
        };
        crate::files::create_directories(directory).map_err(failed(directory))?;
        self.figures.iter().try_for_each(|(name, svg)| {
            let path = directory.join(format!("{name}.svg"));
            crate::files::write(&path, svg.as_bytes()).map_err(failed(&path))
        })
    }

    /// Writes the page.
    ///
    /// # Errors
    /// [`ReportError::Write`].
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        crate::files::write(path, self.html.as_bytes())
            .map_err(|source| ReportError::Write { path: path.to_owned(), source })
    }
}

/// Makes a page of a run's directory, of a recording alone, or of a campaign's directory; of a run with the fields that are `shown` by name, such as
/// `leader/estimate.omega_rad_s` or `leader/estimate.omega_rad_s[2]`.
///
/// # Errors
/// [`ReportError`].
pub fn report(path: &Path, shown: &[String]) -> Result<Report, ReportError> {
    if Table::is_in(path) {
        return campaign(path, shown);
    }
    let source = Source::open(path)?;
    let model = single::model(&source, shown)?;
    let damaged = source.recording.as_ref().is_some_and(|recording| recording.damage().is_some());
    Ok(Report { html: page::page(&model), figures: page::figures(&model), remarks: model.remarks, damaged })
}

fn campaign(directory: &Path, shown: &[String]) -> Result<Report, ReportError> {
    if !shown.is_empty() {
        return Err(ReportError::CampaignWith { path: directory.to_owned(), with: "--show" });
    }
    let model = campaign::model(&Table::read(directory)?, directory);
    Ok(Report { html: page::page(&model), figures: page::figures(&model), remarks: model.remarks, damaged: false })
}

/// Makes a page of two runs over each other, with the fields that are `shown` by name.
///
/// # Errors
/// [`ReportError`].
pub fn report_pair(a: &Path, b: &Path, shown: &[String]) -> Result<Report, ReportError> {
    if let Some(path) = [a, b].into_iter().find(|path| Table::is_in(path)) {
        return Err(ReportError::CampaignWith { path: path.to_owned(), with: "another" });
    }
    let (a, b) = (Source::open(a)?, Source::open(b)?);
    let model = pair::model(&a, &b, shown)?;
    let damaged = [&a, &b].iter().filter_map(|source| source.recording.as_ref()).any(|r| r.damage().is_some());
    Ok(Report { html: page::page(&model), figures: page::figures(&model), remarks: model.remarks, damaged })
}
