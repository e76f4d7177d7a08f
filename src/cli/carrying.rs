//! What a person types to relate two shapes.

use super::InCollection;
use clap::Args;
use std::path::PathBuf;

/// `coseg map`
#[derive(Debug, Args)]
pub(crate) struct Map {
    /// Functions are carried from this shape
    pub(crate) from: String,
    /// Functions are carried to this shape
    pub(crate) to: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Write c_12, p2p_21 and where something corresponds to this safetensors file
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// Draw both shapes, with colours carried over, and the entries of c_12 to this PNG file
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// A map between points, computed once, in place of the one that carries labels
    #[arg(long)]
    pub(crate) points: bool,
    /// With --points: the map that takes left for right
    #[arg(long, requires = "points")]
    pub(crate) mirrored: bool,
    /// With --points: proxy vertices of both shapes that correspond, as FROM:TO; may be given again
    #[arg(long, requires = "points", value_name = "FROM:TO", value_parser = landmark)]
    pub(crate) landmark: Vec<(u32, u32)>,
}

/// `coseg transfer`
#[derive(Debug, Args)]
pub(crate) struct Transfer {
    /// Values are carried from this shape
    pub(crate) from: String,
    /// Values are carried to this shape
    pub(crate) to: String,
    #[command(flatten)]
    pub(crate) within: InCollection,
    /// Values at the faces of the first, in the order of its file: .npy, or text with a row a face. Integers are labels, others
    /// functions, of one or several columns
    #[arg(long, value_name = "FILE")]
    pub(crate) values: PathBuf,
    /// Write the values at the faces of the second to this file, as NumPy if it ends in .npy, else as text [default: text to
    /// stdout]. Where nothing corresponds labels are -1, functions NaN
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
    /// By the map that takes left for right
    #[arg(long)]
    pub(crate) mirrored: bool,
    /// Proxy vertices of both shapes that correspond, as FROM:TO; may be given again
    #[arg(long, value_name = "FROM:TO", value_parser = landmark)]
    pub(crate) landmark: Vec<(u32, u32)>,
}

/// `FROM:TO`, two vertices.
fn landmark(text: &str) -> Result<(u32, u32), String> {
    let parsed = text
        .split_once(':')
        .and_then(|(from, to)| Some((from.parse().ok()?, to.parse().ok()?)));
    parsed.ok_or_else(|| format!("{text:?} is not FROM:TO, two vertex numbers"))
}
