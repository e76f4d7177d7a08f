//! Keeps the parts of shapes that were asked about lately in memory.

use super::error::Result;
use super::sources::Sources;
use crate::pipeline::ShapeParts;
use crate::store::ShapeId;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Shapes whose parts are remembered: about 30 KB each.
const MAX_REMEMBERED: usize = 512;

/// A shape and the bits of the up axis along which its parts were made.
type PartsKey = (ShapeId, [u64; 3]);

/// The parts of shapes that were asked about lately, so that the next question is quick.
#[derive(Debug, Default)]
pub(super) struct RememberedParts(Mutex<HashMap<PartsKey, Arc<ShapeParts>>>);

impl RememberedParts {
    /// The parts of a shape, computed if they are not remembered.
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
