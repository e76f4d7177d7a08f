//! Divides the faces of one shape into patches and parts, without knowledge of other shapes.

mod parts;
mod patches;
mod surface;

pub use parts::{PartGraph, merge_patches, parts};
pub use patches::patches;
pub use surface::{PatchGraph, Surface, SurfaceEdge};
