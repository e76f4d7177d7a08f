//! Recomputes stored maps that do not agree with the others, through the latent functions on which
//! the others agree.

use super::change::{Change, commit, map_row};
use super::collection::Collection;
use super::error::Result;
use super::facade::Library;
use super::rows::{damaged, quality_from_json};
use super::sources::Sources;
use super::types::MapInfo;
use super::voting::PreparedShape;
use crate::fmap::FunctionalMap;
use crate::fmap::consistency::{Link, Standing, leading};
use crate::fmap::latent::LatentBasis;
use crate::store::agreement::KeptMaps;
use crate::store::{CollectionRow, ShapeId, Store};

/// Maximum number of shapes for which the latent functions are solved together; the others are
/// added one by one.
const MAX_TOGETHER: usize = 40;

/// A stored map that does not agree with the maps through other shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct Disagreement {
    /// The shape from which the map carries functions.
    pub from: ShapeId,
    /// The shape to which it carries them.
    pub to: ShapeId,
    /// How the map agrees with the others.
    pub standing: Standing,
}

impl Library {
    /// Returns the stored maps of a collection that do not agree with the others.
    ///
    /// # Errors
    /// There is no such collection, or the catalog cannot be read.
    pub fn disagreements(&self, collection: &str) -> Result<Vec<Disagreement>> {
        let row = self.collection_row(collection)?;
        let kept = self.kept_maps(&row)?;
        Ok(disagreements(&kept, &kept.standings()))
    }

    /// Recomputes the stored maps of a collection that do not agree with the others: once through
    /// the latent functions of the others, then refined, and once from nearest neighbours of
    /// descriptors, like a new map. Stores the one that agrees better with the others, unless the
    /// stored map agrees better still. The shapes to which the maps lead become stale. Returns a
    /// line of text for each map.
    ///
    /// # Errors
    /// There is no such collection, or it cannot be read or written.
    pub fn mend_maps(&self, collection: &str) -> Result<Vec<String>> {
        let row = self.collection_row(collection)?;
        self.with_collection(row, |collection| self.mend_in(collection))
    }

    /// Returns how a map for parts agrees with the stored ones of its collection; `None` if it is
    /// too small to compare.
    ///
    /// # Errors
    /// There is no such collection or shape, or the catalog cannot be read.
    pub fn standing(
        &self,
        collection: &str,
        from: &str,
        to: &str,
        map: &MapInfo,
    ) -> Result<Option<Standing>> {
        let (_, a) = self.shape_row(collection, from)?;
        let (row, b) = self.shape_row(collection, to)?;
        let kept = self.kept_maps(&row)?;
        Ok(kept.standing_of(a.id, b.id, &map.c_12, map.k1))
    }

    fn kept_maps(&self, row: &CollectionRow) -> Result<KeptMaps> {
        let catalog = self.store.catalog();
        catalog.read(|r| -> Result<_> { Ok(KeptMaps::read(r, row.id)?) })
    }

    fn mend_in(&self, collection: &mut Collection) -> Result<Vec<String>> {
        let stored = self.kept_maps(collection.row())?;
        let standings = stored.standings();
        let wrong = disagreements(&stored, &standings);
        let Some(model) = collection.model().filter(|_| !wrong.is_empty()) else {
            return Ok(Vec::new());
        };
        let model = model.base_model();
        let (latent, position) = self.latent(&stored, &standings)?;
        let mut done = Vec::new();
        for d in &wrong {
            let (from, to) = (self.store.known(d.from)?, self.store.known(d.to)?);
            let names = format!("{} to {}", from.row.name, to.row.name);
            let at = |id: ShapeId| stored.shapes.binary_search(&id).ok();
            let (Some(i), Some(j)) = (at(d.from), at(d.to)) else {
                continue;
            };
            let shapes = [&from, &to].map(|k| PreparedShape::new(&self.store, k.file(), &model));
            let mut tries = vec![shapes[0].map_to(&shapes[1])];
            if let (Some(x), Some(y)) = (position[i], position[j]) {
                let start = latent.through(x, y);
                tries.push(shapes[0].map_grown_from(&shapes[1], (&start, stored.k)));
            }
            let best = best_fitting(&stored, &standings, (i, j), tries);
            let old = self.store.map(d.from, d.to)?;
            let Some(((after, new), old)) = best.zip(old) else {
                continue;
            };
            let before = d.standing.departure;
            let was = quality_from_json(&old.quality_json, &format!("maps {names}"))?.confidence;
            if after >= before {
                done.push(format!(
                    "map {names}: disagrees ({before:.2}), and no better one was found"
                ));
                continue;
            }
            let change = Change {
                maps: vec![map_row(d.from, d.to, &new)],
                stale: vec![(d.to, true)],
                ..Change::default()
            };
            commit(&self.store, collection, change, |_, _| Ok(()))?;
            done.push(format!(
                "map {names}: recomputed, departure {before:.2} to {after:.2}, \
                 confidence {was:.2} to {:.2}",
                new.quality.confidence
            ));
        }
        Ok(done)
    }

    /// Computes the latent functions of the maps that agree, and the position of each shape among
    /// them, if it has one.
    fn latent(
        &self,
        kept: &KeptMaps,
        standings: &[Standing],
    ) -> Result<(LatentBasis, Vec<Option<usize>>)> {
        let good: Vec<(usize, usize, &[f32])> = kept
            .maps
            .iter()
            .zip(standings)
            .filter(|(_, s)| !s.inconsistent)
            .map(|((from, to, c), _)| (*from, *to, c.as_slice()))
            .collect();
        let linked = |s: usize| good.iter().any(|m| m.0 == s || m.1 == s);
        let order: Vec<usize> = (0..kept.shapes.len()).filter(|s| linked(*s)).collect();
        let mut position = vec![None; kept.shapes.len()];
        let mut values = Vec::with_capacity(order.len());
        for (p, &s) in order.iter().enumerate() {
            position[s] = Some(p);
            let known = self.store.known(kept.shapes[s])?;
            values.push(known.view().eigenvalues[..kept.k].to_vec());
        }
        let together = order.len().min(MAX_TOGETHER);
        let links: Vec<Link<'_>> = good
            .iter()
            .filter_map(|(from, to, c_12)| {
                Some(Link {
                    from: position[*from]?,
                    to: position[*to]?,
                    c_12,
                    weight: 1.0,
                })
            })
            .collect();
        let within = |l: &&Link<'_>| l.from < together && l.to < together;
        let first: Vec<Link<'_>> = links.iter().filter(within).copied().collect();
        let slices: Vec<&[f64]> = values.iter().map(Vec::as_slice).collect();
        let solved = LatentBasis::solve(&slices[..together], &first, kept.k);
        let mut latent = solved.map_err(|e| damaged("maps", &e.to_string()))?;
        for (p, values) in slices.iter().enumerate().skip(together) {
            let into: Vec<Link<'_>> = links
                .iter()
                .filter(|l| l.to == p && l.from < p)
                .copied()
                .collect();
            latent.insert(values, &into);
        }
        Ok((latent, position))
    }
}

/// Counts the maps to a new shape that do not agree with the maps between the shapes they come
/// from, and logs them. Their votes keep the weight of their confidence.
pub(super) fn n_inconsistent(store: &Store, maps: &[(ShapeId, FunctionalMap)]) -> Result<u32> {
    let sources = maps.iter().map(|(from, _)| *from).collect();
    let catalog = store.catalog();
    let kept = catalog.read(|r| -> Result<_> { Ok(KeptMaps::among(r, sources)?) })?;
    let new: Vec<_> = maps
        .iter()
        .map(|(from, map)| (*from, map.c_12.as_slice(), map.k1))
        .collect();
    let mut n = 0;
    for (from, standing) in kept.standings_of_new(&new) {
        if standing.inconsistent {
            let Standing {
                departure,
                n_triangles,
                ..
            } = standing;
            tracing::info!(%from, departure, n_triangles, "a map to the new shape disagrees");
            n += 1;
        }
    }
    Ok(n)
}

/// Returns the map from the shape `i` to the shape `j` that departs least from the maps that agree,
/// and by how much it departs.
fn best_fitting(
    stored: &KeptMaps,
    standings: &[Standing],
    (i, j): (usize, usize),
    tries: Vec<FunctionalMap>,
) -> Option<(f64, FunctionalMap)> {
    let departure = |map: &FunctionalMap| -> f64 {
        let others = stored.maps.iter().zip(standings);
        let mut maps: Vec<(usize, usize, Vec<f32>)> = others
            .filter(|((f, t, _), s)| !s.inconsistent && (*f, *t) != (i, j))
            .map(|(m, _)| m.clone())
            .collect();
        maps.push((i, j, leading(&map.c_12, map.k1, stored.k, stored.k)));
        let with = KeptMaps {
            maps,
            ..stored.clone()
        };
        with.standings().last().map_or(0.0, |s| s.departure)
    };
    let comparable = tries.into_iter();
    let comparable = comparable.filter(|m| m.k1 >= stored.k && m.k2 >= stored.k);
    comparable
        .map(|m| (departure(&m), m))
        .min_by(|x, y| x.0.total_cmp(&y.0))
}

fn disagreements(kept: &KeptMaps, standings: &[Standing]) -> Vec<Disagreement> {
    let maps = kept.maps.iter().zip(standings);
    maps.filter(|(_, s)| s.inconsistent)
        .map(|((from, to, _), standing)| Disagreement {
            from: kept.shapes[*from],
            to: kept.shapes[*to],
            standing: *standing,
        })
        .collect()
}
