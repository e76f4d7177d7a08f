//! Defines the flags of commands that relate two shapes.

use super::InCollection;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// What the rows of an array are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Resolution {
    /// The vertices of the file, in its order
    Input,
    /// The faces of the file, in its order
    InputFaces,
    /// The vertices of the proxy, the mesh on which coseg computes
    Proxy,
}

/// `coseg map`
#[derive(Debug, Args)]
pub(crate) struct Map {
    /// The shape whose functions are transferred
    pub(crate) from: String,
    /// The shape that receives them
    pub(crate) to: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Write c_12, p2p_21, the matched rows and the confidence to this safetensors file
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// The rows of the pointwise map that --out writes
    #[arg(long, requires = "out", default_value = "input")]
    pub(crate) resolution: Resolution,
    /// Draw both shapes, with transferred colours, and the entries of c_12 to this PNG file
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// Compute a map between points, instead of the part map that propagates labels
    #[arg(long)]
    pub(crate) points: bool,
    /// With --points: the map that exchanges left and right
    #[arg(long, requires = "points")]
    pub(crate) mirrored: bool,
    /// With --points: corresponding vertices of both files, from 0, as FROM:TO; may be repeated
    #[arg(long, requires = "points", value_name = "FROM:TO", value_parser = landmark)]
    pub(crate) landmark: Vec<(u32, u32)>,
}

/// `coseg transfer`
#[derive(Debug, Args)]
pub(crate) struct Transfer {
    /// The shape whose values are transferred
    pub(crate) from: String,
    /// The shape that receives them
    pub(crate) to: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Values at the faces of the first shape, in the order of its file: .npy, or text with one row
    /// for each face. Integers are labels; other values are functions, of one or several columns
    #[arg(long, value_name = "FILE")]
    pub(crate) values: PathBuf,
    /// The rows of the values, given and written
    #[arg(long, default_value = "input-faces")]
    pub(crate) resolution: Resolution,
    /// Write the values at the second shape to this file, as NumPy if it ends in .npy, else as text
    /// [default: text to stdout]. Rows without counterpart get the label -1, or NaN
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Use the map that exchanges left and right
    #[arg(long)]
    pub(crate) mirrored: bool,
    /// Corresponding vertices of both files, from 0, as FROM:TO; may be repeated
    #[arg(long, value_name = "FROM:TO", value_parser = landmark)]
    pub(crate) landmark: Vec<(u32, u32)>,
}

/// Parses `FROM:TO`, two vertices.
fn landmark(text: &str) -> Result<(u32, u32), String> {
    let parsed = text
        .split_once(':')
        .and_then(|(from, to)| Some((from.parse().ok()?, to.parse().ok()?)));
    parsed.ok_or_else(|| format!("{text:?} is not FROM:TO, two vertex numbers"))
}
