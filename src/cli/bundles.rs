//! Defines the flags of commands about bundles.

use super::{ExportFormat, ExportMaterials, OneCollection};
use clap::Args;
use std::path::PathBuf;

/// `coseg publish`
#[derive(Debug, Args)]
pub(crate) struct Publish {
    #[command(flatten)]
    pub(crate) of: OneCollection,
    /// The bundle to write, such as chairs.coseg
    #[arg(long, short, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Do not wait for queued shapes and relabellings
    #[arg(long)]
    pub(crate) no_wait: bool,
}

/// `coseg label`
#[derive(Debug, Args)]
pub(crate) struct LabelMeshes {
    /// Mesh files, or folders of them (.obj, .off, .ply, .stl, .glb, .gltf)
    #[arg(required = true, value_name = "MESH")]
    pub(crate) paths: Vec<PathBuf>,
    /// The bundle that `coseg publish` wrote
    #[arg(long, short, value_name = "FILE")]
    pub(crate) bundle: PathBuf,
    /// Folder for the files, created if missing: NAME.report.json, and labels in the format
    #[arg(long, short, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// The format to write for each mesh, as `coseg export` does; not obj
    #[arg(long, value_name = "FORMAT", default_value = "labels")]
    pub(crate) format: ExportFormat,
    /// Materials of parts, for glb and ply of a glTF or an OBJ
    #[arg(long, value_name = "WHICH", default_value = "own")]
    pub(crate) materials: ExportMaterials,
    /// A subset for each part, such as leg_001, in place of one for each label, for usda
    #[arg(long)]
    pub(crate) instances: bool,
    /// Add the probability of each face's label to NAME.report.json
    #[arg(long)]
    pub(crate) confidence: bool,
    /// Also label meshes in subfolders, named by their path, with __ for each /
    #[arg(long, short)]
    pub(crate) recursive: bool,
    /// Number of threads; the labels do not depend on it [default: one for each processor]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub(crate) threads: Option<u32>,
}
