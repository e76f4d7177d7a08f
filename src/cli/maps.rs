//! Defines the flags of commands that relate two shapes.

use super::InCollection;
use clap::Args;
use std::path::PathBuf;

/// `coseg map`
#[derive(Debug, Args)]
pub(crate) struct Map {
    /// The shape whose functions are transferred
    pub(crate) from: String,
    /// The shape that receives them
    pub(crate) to: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Write c_12, p2p_21 and the matched vertices to this safetensors file
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Draw both shapes, with transferred colours, and the entries of c_12 to this PNG file
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// Compute a map between points, instead of the part map that propagates labels
    #[arg(long)]
    pub(crate) points: bool,
    /// With --points: the map that exchanges left and right
    #[arg(long, requires = "points")]
    pub(crate) mirrored: bool,
    /// With --points: corresponding proxy vertices of both shapes, as FROM:TO; may be repeated
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
    /// Write the values at the faces of the second shape to this file, as NumPy if it ends in .npy,
    /// else as text [default: text to stdout]. Faces without counterpart get the label -1, or NaN
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Use the map that exchanges left and right
    #[arg(long)]
    pub(crate) mirrored: bool,
    /// Corresponding proxy vertices of both shapes, as FROM:TO; may be repeated
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
