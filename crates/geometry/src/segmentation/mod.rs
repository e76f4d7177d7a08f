//! One shape's faces become patches and parts, before anything is known of other shapes.

mod parts;
mod patches;
mod surface;

pub use parts::{PartGraph, merge_patches, parts};
pub use patches::patches;
pub use surface::{PatchGraph, Surface, SurfaceEdge};
