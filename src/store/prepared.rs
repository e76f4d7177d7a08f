//! Surfaces and standardised descriptors of stored shapes stay in memory between uses.
//!
//! Both follow from an array file, the descriptors also from a standardisation, so an entry is
//! named by the digests of these and is never out of date. The least recently used entries go
//! first.

use super::Digest;
use crate::labels::LabelModel;
use crate::pipeline::{DescriptionView, Prepared};
use crate::segmentation::{Surface, SurfaceEdge};
use hashlink::LinkedHashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes of prepared shapes that stay in memory, unless another bound is set: about eighty shapes
/// of the default 2,500 working faces, which are more than the representatives and training shapes
/// that vote in a collection.
pub const DEFAULT_PREPARED_BYTES: usize = 128 << 20;

/// Prepared shapes in memory, of all collections of a library.
pub struct PreparedShapes(Mutex<State>);

struct State {
    /// Least recently used first.
    entries: LinkedHashMap<Key, (Entry, usize)>,
    n_bytes: usize,
    max_bytes: usize,
}

/// The digests of an array file and, where descriptors are standardised, of the standardisation.
type Key = (Digest, Option<Digest>);

#[derive(Clone)]
enum Entry {
    Surface(Arc<Surface>),
    Shape(Arc<Prepared>),
}

impl Default for PreparedShapes {
    fn default() -> Self {
        Self(Mutex::new(State {
            entries: LinkedHashMap::new(),
            n_bytes: 0,
            max_bytes: DEFAULT_PREPARED_BYTES,
        }))
    }
}

impl PreparedShapes {
    /// The surface of a proxy; `file` is the digest of its array file.
    pub fn surface(&self, file: &Digest, shape: &DescriptionView<'_>) -> Arc<Surface> {
        let key = (*file, None);
        if let Some(Entry::Surface(surface)) = self.state().used(&key) {
            return surface;
        }
        let surface = Arc::new(Surface::new(&shape.mesh()));
        let n_bytes = surface_bytes(&surface);
        self.state()
            .insert(key, Entry::Surface(Arc::clone(&surface)), n_bytes);
        surface
    }

    /// A shape prepared under the standardisation of a model; `file` is the digest of its array
    /// file.
    pub fn shape(
        &self,
        file: &Digest,
        shape: &DescriptionView<'_>,
        model: &LabelModel,
    ) -> Arc<Prepared> {
        let key = (*file, Some(standardisation(model)));
        if let Some(Entry::Shape(prepared)) = self.state().used(&key) {
            return prepared;
        }
        let prepared = Arc::new(Prepared::on(self.surface(file, shape), shape, model));
        // The surface is counted twice: it may leave as an entry before the shape does.
        let n_floats = prepared.features.data.len() + prepared.at_vertices.len();
        let n_bytes = size_of::<f32>() * n_floats + surface_bytes(&prepared.surface);
        self.state()
            .insert(key, Entry::Shape(Arc::clone(&prepared)), n_bytes);
        prepared
    }

    /// Bounds the bytes that stay in memory; 0 keeps nothing.
    pub fn set_max_bytes(&self, max_bytes: usize) {
        let mut state = self.state();
        state.max_bytes = max_bytes;
        state.trim();
    }

    /// Bytes of the shapes in memory.
    pub fn n_bytes(&self) -> usize {
        self.state().n_bytes
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing that panics is called while the lock is held.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn used(&mut self, key: &Key) -> Option<Entry> {
        self.entries.to_back(key).map(|(entry, _)| entry.clone())
    }

    fn insert(&mut self, key: Key, entry: Entry, n_bytes: usize) {
        // Two threads may have prepared the same shape.
        if let Some((_, before)) = self.entries.insert(key, (entry, n_bytes)) {
            self.n_bytes -= before;
        }
        self.n_bytes += n_bytes;
        self.trim();
    }

    fn trim(&mut self) {
        while self.n_bytes > self.max_bytes {
            let Some((_, (_, n_bytes))) = self.entries.pop_front() else {
                return;
            };
            self.n_bytes -= n_bytes;
        }
    }
}

fn surface_bytes(surface: &Surface) -> usize {
    size_of_val(&surface.area[..])
        + size_of_val(&surface.centroids[..])
        + surface.edges.len() * size_of::<SurfaceEdge>()
}

/// The digest of everything in a model that descriptors depend on.
fn standardisation(model: &LabelModel) -> Digest {
    let normalisation = &model.normalisation;
    let up = model.up.unwrap_or_default();
    let is_up_known = [
        u8::from(model.up.is_some()),
        u8::from(normalisation.up_known),
    ];
    Digest::of_pieces(&[
        &is_up_known,
        bytemuck::cast_slice(&up),
        bytemuck::cast_slice(&normalisation.mean),
        bytemuck::cast_slice(&normalisation.deviation),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::{Description, Params};
    use crate::labels::{Features, Normalisation, Statistics};
    use crate::mesh::{Format, write};
    use crate::pipeline::describe;
    use crate::synth::{Family, Options, family};

    fn shapes() -> Vec<Description> {
        let options = Options {
            n_faces: 280,
            rotate: false,
        };
        let params = Params {
            working_faces: 300,
            n_eigenpairs: 20,
            ..Params::default()
        };
        let described = |mesh| {
            let file = write::off(mesh);
            describe(file.as_bytes(), Format::Off, &params, &|_| true).expect("a made shape")
        };
        let made = family(Family::Pliers, 5, 3, &options);
        made.iter().map(|s| described(&s.mesh)).collect()
    }

    fn model(shape: &Description, up: Option<[f64; 3]>) -> LabelModel {
        let raw = Features::raw(&shape.view(), up);
        let area = Surface::new(&shape.view().mesh()).area.clone();
        let normalisation = Normalisation::fit([(&raw, &area[..])].into_iter(), up.is_some());
        LabelModel {
            epoch: 1,
            labels: vec![0],
            statistics: Statistics::empty(1, normalisation.mean.len()),
            normalisation,
            up,
        }
    }

    #[test]
    fn a_shape_in_memory_is_what_would_be_prepared() {
        let shapes = shapes();
        let cache = PreparedShapes::default();
        let models = [
            model(&shapes[0], None),
            model(&shapes[1], None),
            model(&shapes[0], Some([0.0, 1.0, 0.0])),
            model(&shapes[0], Some([0.0, 0.0, 1.0])),
        ];
        for _ in 0..2 {
            for model in &models {
                for (n, shape) in shapes.iter().enumerate() {
                    let file = Digest::of(&[n as u8]);
                    let found = cache.shape(&file, &shape.view(), model);
                    let fresh = Prepared::new(&shape.view(), model);
                    assert_eq!(found.surface, fresh.surface);
                    assert_eq!(found.features, fresh.features);
                    assert_eq!(found.at_vertices, fresh.at_vertices);
                }
            }
        }
        let file = Digest::of(&[0]);
        let again = || cache.shape(&file, &shapes[0].view(), &models[0]);
        assert!(Arc::ptr_eq(&again(), &again()), "it is prepared once");
    }

    #[test]
    fn the_least_recently_used_shapes_go_first() {
        let shapes = shapes();
        let model = model(&shapes[0], None);
        let files = [0, 1, 2].map(|n: u8| Digest::of(&[n]));
        let cache = PreparedShapes::default();
        let get = |n: usize| cache.shape(&files[n], &shapes[n].view(), &model);
        let first = get(0);
        let of_one = cache.n_bytes();
        let more = size_of_val(&first.features.data[..]);
        assert!(
            of_one > more,
            "{of_one} bytes are counted, {more} are descriptors"
        );
        let second = get(1);
        let bound = cache.n_bytes() + of_one / 2;
        cache.set_max_bytes(bound);
        assert!(Arc::ptr_eq(&first, &get(0)));
        get(2);
        assert!(cache.n_bytes() <= bound);
        assert!(Arc::ptr_eq(&first, &get(0)), "it was used after the second");
        assert!(
            !Arc::ptr_eq(&second, &get(1)),
            "it was used before the others"
        );
        cache.set_max_bytes(0);
        assert_eq!(cache.n_bytes(), 0);
        assert_eq!(get(1).features, second.features);
        assert_eq!(cache.n_bytes(), 0);
    }
}
