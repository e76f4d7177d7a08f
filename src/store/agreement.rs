//! The kept maps of a collection, and which of them do not agree with the others.

use super::catalog::Reader;
use super::error::StoreError;
use super::rows::{CollectionId, ShapeId};
use crate::fmap::consistency::{Link, Numbered, Standing, leading, links, standings};

/// Rows and columns by which maps are compared; maps are less alike the finer they are.
const K_COMPARED: u32 = 20;

/// The leading blocks of the maps of one collection.
#[derive(Debug, Clone, PartialEq)]
pub struct KeptMaps {
    /// Its shapes, in the order of their ids.
    pub shapes: Vec<ShapeId>,
    /// Rows and columns of each block.
    pub k: usize,
    /// From, to (positions in `shapes`), and the block, row-major.
    pub maps: Vec<Numbered>,
}

impl KeptMaps {
    /// Reads them. Maps smaller than usual are left out.
    ///
    /// # Errors
    /// A row is damaged, or the catalog cannot be read.
    pub fn read(reader: &Reader<'_>, collection: CollectionId) -> Result<Self, StoreError> {
        let rows = reader.shapes(collection, 0, usize::MAX, None)?;
        let mut shapes: Vec<ShapeId> = rows.into_iter().map(|row| row.id).collect();
        shapes.sort_unstable();
        let k = K_COMPARED as usize;
        let mut maps = Vec::new();
        for (to, id) in shapes.iter().enumerate() {
            for map in reader.maps_into(*id)? {
                let Ok(from) = shapes.binary_search(&map.from) else {
                    continue;
                };
                if map.k1 >= K_COMPARED && map.k2 >= K_COMPARED {
                    maps.push((from, to, leading(&map.c_12, map.k1 as usize, k, k)));
                }
            }
        }
        Ok(Self { shapes, k, maps })
    }

    /// The maps as links of equal weight.
    pub fn links(&self) -> Vec<Link<'_>> {
        links(&self.maps)
    }

    /// How each of them agrees with the others.
    pub fn standings(&self) -> Vec<Standing> {
        standings(&vec![self.k; self.shapes.len()], &self.links())
    }
}
