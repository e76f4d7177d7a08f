//! Array files: one immutable safetensors file per description, memory-mapped.

use crate::pipeline::DescriptionView;

/// A description whose arrays are mapped from its file.
pub struct MappedDescription {}

impl MappedDescription {
    /// The arrays, borrowed from the map.
    pub fn view(&self) -> DescriptionView<'_> { unimplemented!() }
}
