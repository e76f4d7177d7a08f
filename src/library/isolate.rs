//! Encodes the work on one shape as bytes, so that another process can do it: the job and its
//! outcome.
//!
//! Both ends are the same program, so the format has no version.

use super::error::{LibraryError, Result};
use super::refusal::refusal;
use super::rows::{format_from_name, operator_from_name, operator_name};
use super::types::Failure;
use crate::mesh::{CleanReport, Format};
use crate::pipeline::{Description, Params, describe};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// A shape to be described, with format and parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct DescribeJob<'a> {
    /// The bytes of a mesh file.
    pub bytes: &'a [u8],
    /// Their format.
    pub format: Format,
    /// Parameters of the description.
    pub params: Params,
}

/// A description, or the reason why the shape was refused.
pub type Described = std::result::Result<Description, Failure>;

/// The origin of the bytes, in errors.
const LOCATION: &str = "the worker's answer";

/// A mirror of [`Description`] for serde, because domain types do not derive it. It does not
/// compile if a field is missing.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Description")]
struct DescriptionFields {
    area: f64,
    #[serde(with = "report")]
    report: CleanReport,
    vertices: Vec<[f32; 3]>,
    faces: Vec<[u32; 3]>,
    mass: Vec<f32>,
    eigenvalues: Vec<f64>,
    eigenvectors: Vec<f32>,
    n_eigenvectors: usize,
    hks: Vec<f32>,
    face_descriptors: Vec<f32>,
    n_descriptors: usize,
    patches: Vec<u32>,
    face_map: Vec<u32>,
    polygon_area: Vec<f32>,
    signature: Vec<f32>,
}

/// A mirror of a description, owned or borrowed, for serde.
#[derive(Serialize)]
struct Encoded<'a>(#[serde(with = "DescriptionFields")] &'a Description);

#[derive(Deserialize)]
struct Decoded(#[serde(with = "DescriptionFields")] Description);

/// Encodes a report as its counts by name.
mod report {
    use crate::library::isolate::LOCATION;
    use crate::library::rows::{report_from_json, report_to_json};
    use crate::mesh::CleanReport;
    use serde::de::Error as _;
    use serde::{Deserialize as _, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(
        report: &CleanReport,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&report_to_json(report).to_string())
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<CleanReport, D::Error> {
        let text = String::deserialize(deserializer)?;
        report_from_json(&text, LOCATION).map_err(D::Error::custom)
    }
}

impl DescribeJob<'_> {
    /// Describes the shape in this process. Calls `stage` with the name of each stage as it begins,
    /// and stops when it returns false.
    ///
    /// # Errors
    /// The shape is refused, or the work was stopped.
    pub fn run(&self, stage: &dyn Fn(&str) -> bool) -> Described {
        describe(self.bytes, self.format, &self.params, stage).map_err(|e| refusal(&e))
    }

    /// Returns all fields except the bytes.
    pub fn header(&self) -> Value {
        json!({
            "format": self.format.name(),
            "operator": operator_name(self.params.operator),
            "working_faces": self.params.working_faces,
            "n_eigenpairs": self.params.n_eigenpairs,
            "only_meaningful": self.params.only_meaningful,
            "threads": self.params.threads,
        })
    }
}

impl<'a> DescribeJob<'a> {
    /// Returns the job of the bytes and of a header that [`DescribeJob::header`] made.
    ///
    /// # Errors
    /// The value is not such a header.
    pub fn from_header(header: &Value, bytes: &'a [u8]) -> Result<Self> {
        let text = |name: &str| header[name].as_str().unwrap_or_default();
        let number = |name: &str| {
            let n = header[name].as_u64().and_then(|n| u32::try_from(n).ok());
            n.ok_or_else(|| bad(&format!("no number {name:?}")))
        };
        Ok(Self {
            bytes,
            format: format_from_name(text("format"), LOCATION)?,
            params: Params {
                operator: operator_from_name(text("operator"), LOCATION)?,
                working_faces: number("working_faces")?,
                n_eigenpairs: number("n_eigenpairs")?,
                only_meaningful: header["only_meaningful"].as_bool().unwrap_or_default(),
                threads: number("threads")?,
            },
        })
    }
}

/// Encodes an outcome.
pub fn encode(outcome: &Described) -> Vec<u8> {
    let outcome = outcome.as_ref().map(Encoded);
    postcard::to_stdvec(&outcome).expect("invariant: lengths are known and memory grows")
}

/// Decodes an outcome that [`encode`] made.
///
/// # Errors
/// The bytes are not exactly one outcome.
pub fn decode(bytes: &[u8]) -> Result<Described> {
    let (outcome, rest): (std::result::Result<Decoded, Failure>, _) =
        postcard::take_from_bytes(bytes).map_err(|e| bad(&e.to_string()))?;
    if !rest.is_empty() {
        return Err(bad(&format!("{} bytes are left", rest.len())));
    }
    Ok(outcome.map(|decoded| decoded.0))
}

fn bad(message: &str) -> LibraryError {
    super::rows::damaged(LOCATION, message)
}

#[cfg(test)]
mod tests {
    use super::{DescribeJob, decode, encode};
    use crate::mesh::Format;
    use crate::pipeline::Params;

    const TETRAHEDRON: &str =
        "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";

    #[test]
    fn work_and_outcome_come_back_to_the_bit() {
        let job = DescribeJob {
            bytes: TETRAHEDRON.as_bytes(),
            format: Format::Off,
            params: Params::default(),
        };
        let same = DescribeJob::from_header(&job.header(), job.bytes).unwrap();
        assert_eq!(same, job);
        let outcome = same.run(&|_| true);
        assert!(outcome.is_ok(), "{outcome:?}");
        let bytes = encode(&outcome);
        assert_eq!(decode(&bytes).unwrap(), outcome);
        let longer = [&bytes[..], &[0]].concat();
        assert!(decode(&longer).is_err());
        for cut in (0..bytes.len()).step_by(97).skip(1) {
            assert!(decode(&bytes[..cut]).is_err(), "{cut}");
        }
        let refused = DescribeJob {
            bytes: b"OFF\n1",
            ..job
        }
        .run(&|_| true);
        assert!(refused.is_err());
        assert_eq!(decode(&encode(&refused)).unwrap(), refused);
    }
}
