//! Remembers the parts of shapes about which a person was asked recently.

use super::error::Result;
use super::sources::Sources;
use crate::pipeline::ShapeParts;
use crate::store::ShapeId;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Maximum number of shapes whose parts are remembered, about 30 KB each.
const MAX_REMEMBERED: usize = 512;

/// A shape, and the bits of the up axis along which it was divided.
type PartsKey = (ShapeId, [u64; 3]);

/// The parts of shapes about which a person was asked recently, so that the next question is quick.
#[derive(Debug, Default)]
pub(super) struct RememberedParts(Mutex<HashMap<PartsKey, Arc<ShapeParts>>>);

impl RememberedParts {
    /// Returns the parts of a shape; computes them if they are not remembered.
    pub(super) fn of(
        &self,
        sources: &dyn Sources,
        id: ShapeId,
        up: Option<[f64; 3]>,
    ) -> Result<Arc<ShapeParts>> {
        let key = (id, up.unwrap_or_default().map(f64::to_bits));
        let lock = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(parts) = lock().get(&key) {
            return Ok(Arc::clone(parts));
        }
        let parts = Arc::new(ShapeParts::new(&sources.known(id)?.view(), up));
        let mut all = lock();
        if all.len() >= MAX_REMEMBERED {
            all.clear();
        }
        all.insert(key, Arc::clone(&parts));
        Ok(parts)
    }
}
