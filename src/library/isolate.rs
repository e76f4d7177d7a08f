//! The work on one shape as bytes, so that another process can do it: what is asked, and what came of it.
//!
//! Both ends are the same program, so nothing here has a version; lengths are checked all the same.

use super::rows::{
    format_from_name, from_json, operator_from_name, operator_name, report_from_json,
    report_to_json, to_json,
};
use super::submit::refusal;
use super::{Failure, LibraryError, Result};
use crate::mesh::Format;
use crate::pipeline::{Description, Params, describe};
use bytemuck::Pod;
use serde_json::{Value, json};

/// What is to be described, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct DescribeJob<'a> {
    /// The bytes of a mesh file.
    pub bytes: &'a [u8],
    /// Their format.
    pub format: Format,
    /// How.
    pub params: Params,
}

/// A description, or why the shape is refused.
pub type Described = std::result::Result<Description, Failure>;

/// Where the other process's bytes came from, in errors.
const PLACE: &str = "the worker's answer";

impl DescribeJob<'_> {
    /// Does it in this process. `stage` is told each stage's name as it begins; when it returns false the work
    /// stops.
    ///
    /// # Errors
    /// Why the shape is refused, or that it was stopped.
    pub fn run(&self, stage: &dyn Fn(&str) -> bool) -> Described {
        describe(self.bytes, self.format, &self.params, stage).map_err(|e| refusal(&e))
    }

    /// Everything but the bytes.
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
    /// From what [`DescribeJob::header`] made, and the bytes.
    ///
    /// # Errors
    /// The header is not one.
    pub fn from_header(header: &Value, bytes: &'a [u8]) -> Result<Self> {
        let text = |name: &str| header[name].as_str().unwrap_or_default();
        let number = |name: &str| {
            let n = header[name].as_u64().and_then(|n| u32::try_from(n).ok());
            n.ok_or_else(|| bad(&format!("no number {name:?}")))
        };
        Ok(Self {
            bytes,
            format: format_from_name(text("format"), PLACE)?,
            params: Params {
                operator: operator_from_name(text("operator"), PLACE)?,
                working_faces: number("working_faces")?,
                n_eigenpairs: number("n_eigenpairs")?,
                only_meaningful: header["only_meaningful"].as_bool().unwrap_or_default(),
                threads: number("threads")?,
            },
        })
    }
}

/// What came of it as bytes.
pub fn encode(outcome: &Described) -> Vec<u8> {
    let mut out = Vec::new();
    let d = match outcome {
        Err(why) => {
            out.push(0);
            out.extend_from_slice(to_json(why).as_bytes());
            return out;
        }
        Ok(d) => d,
    };
    out.push(1);
    out.extend_from_slice(&d.area.to_le_bytes());
    for n in [d.n_eigenvectors, d.n_descriptors] {
        out.extend_from_slice(&(n as u64).to_le_bytes());
    }
    put(&mut out, report_to_json(&d.report).to_string().as_bytes());
    put(&mut out, &d.vertices);
    put(&mut out, &d.faces);
    put(&mut out, &d.mass);
    put(&mut out, &d.eigenvalues);
    put(&mut out, &d.eigenvectors);
    put(&mut out, &d.hks);
    put(&mut out, &d.face_descriptors);
    put(&mut out, &d.patches);
    put(&mut out, &d.face_map);
    put(&mut out, &d.polygon_area);
    put(&mut out, &d.signature);
    out
}

/// The same back.
///
/// # Errors
/// The bytes are not what [`encode`] makes.
pub fn decode(bytes: &[u8]) -> Result<Described> {
    let (kind, mut rest) = bytes.split_first().ok_or_else(|| bad("it is empty"))?;
    if *kind == 0 {
        let text = std::str::from_utf8(rest).map_err(|e| bad(&e.to_string()))?;
        return Ok(Err(from_json(text, PLACE)?));
    }
    let rest = &mut rest;
    let area = f64::from_le_bytes(take_8(rest)?);
    let n_eigenvectors = u64::from_le_bytes(take_8(rest)?) as usize;
    let n_descriptors = u64::from_le_bytes(take_8(rest)?) as usize;
    let report: Vec<u8> = take(rest)?;
    let report = String::from_utf8(report).map_err(|e| bad(&e.to_string()))?;
    let description = Description {
        area,
        report: report_from_json(&report, PLACE)?,
        vertices: take(rest)?,
        faces: take(rest)?,
        mass: take(rest)?,
        eigenvalues: take(rest)?,
        eigenvectors: take(rest)?,
        n_eigenvectors,
        hks: take(rest)?,
        face_descriptors: take(rest)?,
        n_descriptors,
        patches: take(rest)?,
        face_map: take(rest)?,
        polygon_area: take(rest)?,
        signature: take(rest)?,
    };
    if !rest.is_empty() {
        return Err(bad(&format!("{} bytes are left", rest.len())));
    }
    Ok(Ok(description))
}

fn bad(message: &str) -> LibraryError {
    super::rows::damaged(PLACE, message)
}

fn put<T: Pod>(out: &mut Vec<u8>, values: &[T]) {
    let bytes: &[u8] = bytemuck::cast_slice(values);
    out.extend_from_slice(&(bytes.len() as u64).to_le_bytes());
    out.extend_from_slice(bytes);
}

fn take_8(rest: &mut &[u8]) -> Result<[u8; 8]> {
    let (head, tail) = rest
        .split_first_chunk()
        .ok_or_else(|| bad("it is cut short"))?;
    *rest = tail;
    Ok(*head)
}

fn take<T: Pod>(rest: &mut &[u8]) -> Result<Vec<T>> {
    let n_bytes = u64::from_le_bytes(take_8(rest)?);
    let n_bytes = usize::try_from(n_bytes)
        .ok()
        .filter(|n| *n <= rest.len() && n.is_multiple_of(size_of::<T>()))
        .ok_or_else(|| {
            bad(&format!(
                "an array of {n_bytes} bytes, but {} are left",
                rest.len()
            ))
        })?;
    let (head, tail) = rest.split_at(n_bytes);
    *rest = tail;
    let values = head.chunks_exact(size_of::<T>());
    Ok(values.map(bytemuck::pod_read_unaligned).collect())
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
