//! Kept maps that do not agree with the others are made anew, by way of the latent functions on which the others agree.

use super::commit::map_row;
use super::lane::Lane;
use super::rows::quality_from_json;
use super::{Library, MapInfo, Result};
use crate::fmap::consistency::{Link, Standing};
use crate::fmap::latent::LatentBasis;
use crate::fmap::{FunctionalMap, MapOptions};
use crate::pipeline::{Prepared, map, map_from};
use crate::store::agreement::KeptMaps;
use crate::store::{CollectionRow, ShapeId};

/// Shapes on which the latent functions are solved for together; the others join one by one.
const MAX_TOGETHER: usize = 40;

/// A kept map that does not agree with those by way of other shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct Disagreement {
    /// Functions are carried from this shape
    pub from: ShapeId,
    /// to this one.
    pub to: ShapeId,
    /// How it stands among the others.
    pub standing: Standing,
}

impl Library {
    /// The kept maps of a collection that do not agree with the others.
    ///
    /// # Errors
    /// There is no such collection, or the catalog cannot be read.
    pub fn disagreements(&self, collection: &str) -> Result<Vec<Disagreement>> {
        let row = self.collection_row(collection)?;
        let kept = self.kept_maps(&row)?;
        Ok(disagreements(&kept, &kept.standings()))
    }

    /// Makes the kept maps of a collection anew that do not agree with the others: by way of the latent functions of the
    /// others, then refined, and from nearest neighbours of descriptors, as at first; the one that fits the others better
    /// is taken, unless that is the map that is kept. The shapes they lead to are labelled anew. What was done, in words.
    ///
    /// # Errors
    /// There is no such collection, or it cannot be read or written.
    pub fn mend_maps(&self, collection: &str) -> Result<Vec<String>> {
        let row = self.collection_row(collection)?;
        self.with_lane(row, |lane| self.mend_in(lane))
    }

    /// How a map for parts agrees with the kept ones of its collection; `None` if it is too small to compare.
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

    /// How many maps to a new shape do not agree with the maps between the shapes they come from. Those are noted in the
    /// log; their votes count as their confidence says.
    pub(super) fn n_inconsistent(&self, maps: &[(ShapeId, FunctionalMap)]) -> Result<u32> {
        let sources = maps.iter().map(|(from, _)| *from).collect();
        let catalog = self.store.catalog();
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

    fn kept_maps(&self, row: &CollectionRow) -> Result<KeptMaps> {
        let catalog = self.store.catalog();
        catalog.read(|r| -> Result<_> { Ok(KeptMaps::read(r, row.id)?) })
    }

    fn mend_in(&self, lane: &mut Lane) -> Result<Vec<String>> {
        let kept = self.kept_maps(&lane.row)?;
        let standings = kept.standings();
        let wrong = disagreements(&kept, &standings);
        let Some(learnt) = lane.learnt.as_ref().filter(|_| !wrong.is_empty()) else {
            return Ok(Vec::new());
        };
        let model = learnt.base_model();
        let (latent, place) = self.latent(&kept, &standings)?;
        let mut done = Vec::new();
        for d in &wrong {
            let (from, to) = (self.known(d.from)?, self.known(d.to)?);
            let names = format!("{} to {}", from.row.name, to.row.name);
            let (one, two) = (from.mapped.view(), to.mapped.view());
            let (a, b) = (Prepared::new(&one, &model), Prepared::new(&two, &model));
            let (one, two) = ((&one, &a), (&two, &b));
            let options = MapOptions::default();
            let mut tries = vec![map(one, two, &options)];
            let at = |id: ShapeId| kept.shapes.binary_search(&id).ok();
            let (Some(i), Some(j)) = (at(d.from), at(d.to)) else {
                continue;
            };
            if let (Some(x), Some(y)) = (place[i], place[j]) {
                let through = latent.through(x, y);
                tries.push(map_from(one, two, (&through, kept.k), &options));
            }
            let departure = |c_12: &[f32]| -> f64 {
                let others = kept.maps.iter().zip(&standings);
                let mut maps: Vec<(usize, usize, Vec<f32>)> = others
                    .filter(|((f, t, _), s)| !s.inconsistent && (*f, *t) != (i, j))
                    .map(|(m, _)| m.clone())
                    .collect();
                maps.push((i, j, c_12.to_vec()));
                let with = KeptMaps {
                    maps,
                    ..kept.clone()
                };
                with.standings().last().map_or(0.0, |s| s.departure)
            };
            let block = |m: &FunctionalMap| {
                crate::fmap::consistency::leading(&m.c_12, m.k1, kept.k, kept.k)
            };
            let best = tries
                .into_iter()
                .filter(|m| m.k1 >= kept.k && m.k2 >= kept.k)
                .map(|m| (departure(&block(&m)), m))
                .min_by(|x, y| x.0.total_cmp(&y.0));
            let old = self.store.catalog().read(|r| r.map(d.from, d.to))?;
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
            self.store.catalog().write(|tx| -> Result<()> {
                tx.put_map(&map_row(d.from, d.to, &new))?;
                Ok(tx.set_stale(d.to, true)?)
            })?;
            if let Some(shape) = lane.shapes.iter_mut().find(|s| s.id == d.to) {
                shape.stale = true;
            }
            done.push(format!(
                "map {names}: made anew, departure {before:.2} to {after:.2}, confidence {was:.2} to {:.2}",
                new.quality.confidence
            ));
        }
        Ok(done)
    }

    /// The latent functions on which maps that agree do so, and where each shape is among them, if it is.
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
        let mut place = vec![None; kept.shapes.len()];
        let mut values = Vec::with_capacity(order.len());
        for (p, &s) in order.iter().enumerate() {
            place[s] = Some(p);
            let known = self.known(kept.shapes[s])?;
            values.push(known.mapped.view().eigenvalues[..kept.k].to_vec());
        }
        let together = order.len().min(MAX_TOGETHER);
        let links: Vec<Link<'_>> = good
            .iter()
            .filter_map(|(from, to, c_12)| {
                Some(Link {
                    from: place[*from]?,
                    to: place[*to]?,
                    c_12,
                    weight: 1.0,
                })
            })
            .collect();
        let within = |l: &&Link<'_>| l.from < together && l.to < together;
        let first: Vec<Link<'_>> = links.iter().filter(within).copied().collect();
        let slices: Vec<&[f64]> = values.iter().map(Vec::as_slice).collect();
        let solved = LatentBasis::solve(&slices[..together], &first, kept.k);
        let mut latent = solved.map_err(|e| super::rows::damaged("maps", &e.to_string()))?;
        for (p, values) in slices.iter().enumerate().skip(together) {
            let into: Vec<Link<'_>> = links
                .iter()
                .filter(|l| l.to == p && l.from < p)
                .copied()
                .collect();
            latent.insert(values, &into);
        }
        Ok((latent, place))
    }
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
