//! Figures as PDF, for papers: the same drawing, its letters from the fonts of this system.
//!
//! Must not draw anything of its own.

use super::ReportError;
use std::sync::Arc;
use svg2pdf::usvg::fontdb::Database;
use svg2pdf::usvg::{Options, Tree};
use svg2pdf::{ConversionOptions, PageOptions};

/// What turns figures into PDF.
pub struct Printer {
    fonts: Arc<Database>,
}

impl Printer {
    /// Finds the fonts.
    ///
    /// # Errors
    /// [`ReportError::Pdf`] where there are none: a figure without its labels is none.
    pub fn new() -> Result<Self, ReportError> {
        let mut fonts = Database::new();
        fonts.load_system_fonts();
        let Some(face) = fonts.faces().next() else {
            let reason = "this system has no fonts; install some (Debian: apt install fonts-dejavu-core)".to_owned();
            return Err(ReportError::Pdf { figure: "a figure".to_owned(), reason });
        };
        // Where no family of the figure is there, any other is better than no letters.
        let family = face.families.first().map(|(name, _)| name.clone()).unwrap_or_default();
        fonts.set_sans_serif_family(family);
        Ok(Self { fonts: Arc::new(fonts) })
    }

    /// One figure.
    ///
    /// # Errors
    /// [`ReportError::Pdf`].
    pub fn print(&self, figure: &str, svg: &str) -> Result<Vec<u8>, ReportError> {
        let failed = |reason: String| ReportError::Pdf { figure: figure.to_owned(), reason };
        let options = Options { fontdb: Arc::clone(&self.fonts), ..Options::default() };
        let tree = Tree::from_str(svg, &options).map_err(|error| failed(error.to_string()))?;
        svg2pdf::to_pdf(&tree, ConversionOptions::default(), PageOptions::default())
            .map_err(|error| failed(error.to_string()))
    }
}
