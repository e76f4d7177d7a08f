//! Reads the stored maps of a collection, and finds maps that disagree with the others.

use super::catalog::Reader;
use super::error::StoreError;
use super::rows::{CollectionId, ShapeId};
use crate::fmap::consistency::{Link, Numbered, Standing, leading, links, standings};

/// Rows and columns by which maps are compared; finer maps agree less.
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
    /// Reads the maps of a collection. Maps smaller than usual are omitted.
    ///
    /// # Errors
    /// If a row is damaged, or the catalog cannot be read.
    pub fn read(reader: &Reader<'_>, collection: CollectionId) -> Result<Self, StoreError> {
        let rows = reader.shapes(collection, 0, usize::MAX, None)?;
        let mut kept = Self::none(rows.into_iter().map(|row| row.id).collect());
        for (to, id) in kept.shapes.clone().into_iter().enumerate() {
            for map in reader.maps_into(id)? {
                if let Ok(from) = kept.shapes.binary_search(&map.from) {
                    kept.push(from, to, &map.c_12, map.k1 as usize);
                }
            }
        }
        Ok(kept)
    }

    /// Reads the maps between a few shapes.
    ///
    /// # Errors
    /// Like [`KeptMaps::read`].
    pub fn among(reader: &Reader<'_>, shapes: Vec<ShapeId>) -> Result<Self, StoreError> {
        let mut kept = Self::none(shapes);
        let ids = kept.shapes.clone();
        for (to, id) in ids.iter().enumerate() {
            for (from, other) in ids.iter().enumerate().filter(|(_, other)| *other != id) {
                if let Some(map) = reader.map(*other, *id)? {
                    kept.push(from, to, &map.c_12, map.k1 as usize);
                }
            }
        }
        Ok(kept)
    }

    fn none(mut shapes: Vec<ShapeId>) -> Self {
        shapes.sort_unstable();
        Self {
            shapes,
            k: K_COMPARED as usize,
            maps: Vec::new(),
        }
    }

    fn push(&mut self, from: usize, to: usize, c_12: &[f32], k1: usize) -> bool {
        let k = self.k;
        let is_large = k1 >= k && c_12.len() >= k * k1;
        if is_large {
            self.maps.push((from, to, leading(c_12, k1, k, k)));
        }
        is_large
    }

    /// The agreement of a map with `k1` columns between two of the shapes with the stored ones, of
    /// which it replaces the one between these shapes; `None` if it is too small.
    pub fn standing_of(
        mut self,
        from: ShapeId,
        to: ShapeId,
        c_12: &[f32],
        k1: usize,
    ) -> Option<Standing> {
        let at = |id| self.shapes.binary_search(&id).ok();
        let (from, to) = (at(from)?, at(to)?);
        self.maps.retain(|(f, t, _)| (*f, *t) != (from, to));
        let is_large = self.push(from, to, c_12, k1);
        is_large.then(|| self.standings().pop()).flatten()
    }

    /// The agreement of maps from some of the shapes to a new one with the stored ones, given their
    /// coefficients and numbers of columns. Maps that are too small are omitted.
    pub fn standings_of_new(
        mut self,
        maps: &[(ShapeId, &[f32], usize)],
    ) -> Vec<(ShapeId, Standing)> {
        let new = self.shapes.len();
        let mut known = Vec::new();
        for &(from, c_12, k1) in maps {
            let at = self.shapes.binary_search(&from);
            if at.is_ok_and(|at| self.push(at, new, c_12, k1)) {
                known.push(from);
            }
        }
        let links = self.links();
        let mut found = standings(&vec![self.k; new + 1], &links);
        let found = found.split_off(links.len() - known.len());
        known.into_iter().zip(found).collect()
    }

    /// The maps as links of equal weight.
    pub fn links(&self) -> Vec<Link<'_>> {
        links(&self.maps)
    }

    /// The agreement of each of the maps with the others.
    pub fn standings(&self) -> Vec<Standing> {
        standings(&vec![self.k; self.shapes.len()], &self.links())
    }
}

#[cfg(test)]
mod tests {
    use super::{K_COMPARED, KeptMaps};
    use crate::store::rows::ShapeId;

    /// A diagonal map with these signs; right maps between these shapes are 1 everywhere.
    fn diagonal(sign: impl Fn(usize) -> f32, k1: usize) -> Vec<f32> {
        let mut c_12 = vec![0.0; K_COMPARED as usize * k1];
        for i in 0..K_COMPARED as usize {
            c_12[i * k1 + i] = sign(i);
        }
        c_12
    }

    #[test]
    fn a_wrong_map_among_new_ones_is_told_from_the_others() {
        let shapes: Vec<ShapeId> = [11, 5, 7, 9].into_iter().map(ShapeId).collect();
        let mut kept = KeptMaps::none(shapes.clone());
        let right = diagonal(|_| 1.0, 20);
        for to in 1..4 {
            for from in 0..to {
                assert!(kept.push(from, to, &right, 20));
            }
        }
        let wide = diagonal(|_| 1.0, 25);
        let wrong = diagonal(|i| if i % 2 == 0 { 1.0 } else { -1.0 }, 20);
        let small = vec![1.0; 19 * 19];
        let new = [
            (shapes[0], wide.as_slice(), 25),
            (shapes[1], right.as_slice(), 20),
            (shapes[2], right.as_slice(), 20),
            (ShapeId(8), right.as_slice(), 20),
            (shapes[3], wrong.as_slice(), 20),
        ];
        let found = kept.clone().standings_of_new(&new);
        let found: Vec<_> = found.iter().map(|(id, s)| (*id, s.inconsistent)).collect();
        let expected = [(0, false), (1, false), (2, false), (3, true)];
        assert_eq!(found, expected.map(|(at, wrong)| (shapes[at], wrong)));
        // The same map in place of a stored one.
        let (from, to) = (shapes[1], shapes[0]);
        let standing = |c_12: &[f32]| kept.clone().standing_of(from, to, c_12, 20).unwrap();
        assert!(standing(&wrong).inconsistent && !standing(&right).inconsistent);
        assert_eq!(standing(&right).n_triangles, 2);
        assert_eq!(kept.clone().standing_of(from, to, &small, 19), None);
        assert_eq!(KeptMaps::none(Vec::new()).standings_of_new(&[]), []);
    }
}
