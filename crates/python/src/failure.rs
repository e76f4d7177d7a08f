//! Errors of the geometry become the exceptions of `coseg.errors`.

use coseg_geometry::describe::DescribeError;
use coseg_geometry::fmap::solve::SolveError;
use coseg_geometry::geodesics::GeodesicError;
use coseg_geometry::mesh::{CleanError, ParseError};
use coseg_geometry::operators::LaplacianError;
use coseg_geometry::spectrum::SpectrumError;
use pyo3::prelude::{PyAnyMethods, PyErr, PyResult, Python};
use pyo3::types::PyDict;
use std::fmt::{Debug, Display};

/// What went wrong, until there is an interpreter to raise it in.
#[derive(Debug)]
pub(crate) struct Failure {
    /// A class of `coseg.errors`.
    class: &'static str,
    /// The name of the variant.
    kind: String,
    message: String,
    /// `face`, `vertex`, `line` and so on, counted as in the message.
    location: Vec<(&'static str, usize)>,
}

impl Failure {
    fn new(class: &'static str, error: &(impl Debug + Display)) -> Self {
        let debug = format!("{error:?}");
        let end = debug.find(|c: char| !c.is_alphanumeric());
        Self {
            class,
            kind: debug[..end.unwrap_or(debug.len())].to_owned(),
            message: error.to_string(),
            location: Vec::new(),
        }
    }

    fn at(mut self, name: &'static str, index: usize) -> Self {
        self.location.push((name, index));
        self
    }

    /// An argument that does not fit the others; the callers of this module check most of them.
    pub(crate) fn argument(message: String) -> Self {
        Self {
            class: "GeometryError",
            kind: "Argument".to_owned(),
            message,
            location: Vec::new(),
        }
    }

    /// A fault of this library.
    pub(crate) fn panic(payload: &(dyn std::any::Any + Send)) -> Self {
        let text = payload.downcast_ref::<&str>().copied();
        let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
        Self {
            class: "GeometryError",
            kind: "Internal".to_owned(),
            message: format!(
                "internal fault, please report it: {}",
                text.unwrap_or("unknown")
            ),
            location: Vec::new(),
        }
    }

    /// The exception.
    pub(crate) fn raise(self, py: Python<'_>) -> PyErr {
        self.exception(py).unwrap_or_else(|error| error)
    }

    fn exception(self, py: Python<'_>) -> PyResult<PyErr> {
        let location = PyDict::new(py);
        for (name, index) in self.location {
            pyo3::types::PyDictMethods::set_item(&location, name, index)?;
        }
        let class = py.import("coseg.errors")?.getattr(self.class)?;
        let raised = class.call1((self.kind, self.message, location))?;
        Ok(PyErr::from_value(raised))
    }
}

impl From<ParseError> for Failure {
    fn from(error: ParseError) -> Self {
        use ParseError as E;
        let failure = Self::new("ParseError", &error);
        match error {
            E::OnlyUnread { line, .. }
            | E::NotANumber { line, .. }
            | E::ShortVertex { line, .. }
            | E::BadLine { line, .. }
            | E::Trailing { line, .. }
            | E::ShortRow { line, .. } => failure.at("line", line),
            E::EmptyFace { line, face } | E::ShortFace { line, face, .. } => {
                failure.at("line", line).at("face", face)
            }
            E::EmptyPolygon { face }
            | E::PolygonTooLarge { face, .. }
            | E::VertexOutOfRange { face, .. }
            | E::NonFinite { face, .. } => failure.at("face", face),
            _ => failure,
        }
    }
}

impl From<CleanError> for Failure {
    fn from(error: CleanError) -> Self {
        Self::new("CleanError", &error)
    }
}

impl From<LaplacianError> for Failure {
    fn from(error: LaplacianError) -> Self {
        use LaplacianError as E;
        let failure = Self::new("LaplacianError", &error);
        match error {
            E::NonFinite { vertex, .. } | E::Unreferenced { vertex } | E::Mass { vertex, .. } => {
                failure.at("vertex", vertex)
            }
            E::OutOfRange { face, vertex, .. } | E::RepeatedCorner { face, vertex } => {
                failure.at("face", face).at("vertex", vertex as usize)
            }
            E::DegenerateFace { face, .. } => failure.at("face", face),
            _ => failure,
        }
    }
}

impl From<GeodesicError> for Failure {
    fn from(error: GeodesicError) -> Self {
        let failure = Self::new("GeometryError", &error);
        match error {
            GeodesicError::Laplacian(error) => error.into(),
            GeodesicError::Source { vertex, .. } => failure.at("vertex", vertex as usize),
            GeodesicError::OutOfReach { vertex, .. } => failure.at("vertex", vertex),
            _ => failure,
        }
    }
}

impl From<SpectrumError> for Failure {
    fn from(error: SpectrumError) -> Self {
        let failure = Self::new("SpectrumError", &error);
        match error {
            SpectrumError::Mass { vertex, .. } => failure.at("vertex", vertex),
            _ => failure,
        }
    }
}

impl From<SolveError> for Failure {
    fn from(error: SolveError) -> Self {
        Self::new("SolveError", &error)
    }
}

impl From<DescribeError> for Failure {
    fn from(error: DescribeError) -> Self {
        match error {
            DescribeError::Parse(error) => error.into(),
            DescribeError::Clean(error) => error.into(),
            DescribeError::Laplacian(error) => error.into(),
            DescribeError::Spectrum(error) => error.into(),
            DescribeError::Cancelled(stage) => SpectrumError::Cancelled { stage }.into(),
        }
    }
}
