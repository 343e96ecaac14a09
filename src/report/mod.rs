//! Reports of a run, two runs or a campaign: charts and tables in one self-contained HTML file.
//!
//! | file | duty |
//! |---|---|
//! | `source` | input: a run's directory, or a recording alone |
//! | `traces` | signals and metrics from one pass over a recording |
//! | `columns` | signals of any length in a bounded number of columns that keep the extremes |
//! | `hidden` | the page of a log's hidden component |
//! | `counterpart` | the reference run that an orbit is compared with |
//! | `percentiles` | latency distributions as curves |
//! | `model` | the content of a page: sections of text, tables and figures |
//! | `single` | the page of one run |
//! | `pair` | the page of two runs |
//! | `pictures` | charts from the samples of a run |
//! | `tables` | tables from the summary |
//! | `late`, `timeline` | late ticks with their causes; the cores around one |
//! | `inputs`, `responses` | changes of inputs; charts and figures of the responses to steps |
//! | `windows` | set point, response and command around a step, tick by tick |
//! | `campaign` | the page of a campaign |
//! | `axis`, `frame`, `chart`, `panels` | charts as SVG |
//! | `html`, `page` | HTML |
//! | `error` | the errors of reports |
//!
//! Must not judge a run: the verdict comes from its summary. Must not omit anything silently: a remark names what is missing.

mod axis;
mod campaign;
mod chart;
mod columns;
mod counterpart;
mod error;
mod frame;
mod hidden;
mod html;
mod inputs;
mod late;
mod model;
mod page;
mod pair;
mod panels;
mod percentiles;
mod pictures;
mod responses;
mod single;
mod source;
mod tables;
mod timeline;
mod traces;
mod windows;

pub use error::ReportError;
pub use hidden::{HiddenFacts, HiddenPage};

use crate::campaign::Table;
use source::Source;
use std::path::Path;

/// A page with its figures and remarks.
#[derive(Debug)]
pub struct Report {
    html: String,
    figures: Vec<(String, String)>,
    remarks: Vec<String>,
    damaged: bool,
}

impl Report {
    /// Returns true if a recording is damaged, so that the page shows only the readable part.
    pub fn is_damaged(&self) -> bool {
        self.damaged
    }

    /// The page as HTML that is also well-formed XML.
    pub fn html(&self) -> &str {
        &self.html
    }

    /// The remarks at the top of the page: missing parts, and how to get them.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// The name and standalone SVG of every figure.
    pub fn figures(&self) -> &[(String, String)] {
        &self.figures
    }

    /// Writes every figure to an SVG file in a directory.
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

/// Makes the page of a run's directory, a recording, or a campaign's directory. The page of a run also shows the fields
/// named by `shown`, such as `leader/estimate.omega_rad_s` or `leader/estimate.omega_rad_s[2]`.
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

/// Makes the page that compares two runs, with the fields named by `shown`.
///
/// # Errors
/// [`ReportError`].
pub fn report_pair(a: &Path, b: &Path, shown: &[String]) -> Result<Report, ReportError> {
    if let Some(path) = [a, b].into_iter().find(|path| Table::is_in(path)) {
        return Err(ReportError::CampaignWith { path: path.to_owned(), with: "a second path" });
    }
    let (a, b) = (Source::open(a)?, Source::open(b)?);
    let model = pair::model(&a, &b, shown)?;
    let damaged = [&a, &b].iter().filter_map(|source| source.recording.as_ref()).any(|r| r.damage().is_some());
    Ok(Report { html: page::page(&model), figures: page::figures(&model), remarks: model.remarks, damaged })
}
