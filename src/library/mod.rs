//! The library: collections of shapes on disk, in process. The daemon is a shell around it.
//!
//! Every method that changes something returns after the change is durable. Shapes are submitted
//! (their bytes become durable), described (pure, on any thread) and placed (one after the other
//! within a collection): [`Library::add`] does all three.
//!
//! ```
//! use coseg::library::{CollectionSpec, NewShape};
//! use coseg::{Library, mesh::Format};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let folder = tempfile::tempdir()?;
//! let library = Library::open(folder.path())?;
//! let spec = CollectionSpec { name: "boxes".into(), n_parts: Some(2), ..Default::default() };
//! library.create_collection(&spec, None)?;
//! let cube = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n\
//!             f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n";
//! let shape = NewShape {
//!     name: "cube".into(),
//!     bytes: cube.into(),
//!     format: Format::Obj,
//!     replace: false,
//! };
//! library.add("boxes", shape)?;
//! let labels = library.labels("boxes", "cube", None)?;
//! assert_eq!(labels.labels.len(), 6); // one for each face of the file, in its order
//! # Ok(())
//! # }
//! ```

mod advance;
mod agreement;
mod before;
mod bundle;
mod change;
mod choose;
mod collection;
mod collections;
mod correct;
mod error;
mod event;
mod facade;
mod history;
pub mod isolate;
mod jobs;
mod labelling;
pub mod likely;
mod linked;
mod links;
mod lookup;
mod merge;
mod names;
mod once;
mod pins;
mod placement;
mod placing;
mod points;
mod proposals;
mod proposed;
mod questions;
mod read;
mod reason;
mod refusal;
mod remote;
mod remove;
mod resolution;
mod repair;
mod remembered;
mod review;
mod review_rows;
mod rows;
mod sources;
mod submit;
mod suggest;
mod types;
mod upright;
mod verdict;
mod voting;

pub use advance::MAX_BATCH;
pub use agreement::Disagreement;
pub use bundle::{
    ArrayFile, Bundle, BundleError, BundleFile, BundleHead, BundleInfo, BundledLabel, LabelledMesh,
    MIN_DISCOVERED_SHAPES, label, write_bundle,
};
pub use choose::Chosen;
pub use collection::discovered::{MAX_MAPS, MAX_REPRESENTATIVES, min_gain, next_recluster};
pub use collections::MAX_PARTS;
pub use correct::{Corrected, Correction, CorrectionOptions, MAX_LABEL, MAX_LABELS};
pub use error::{LibraryError, Named};
pub use event::{Event, EventKind, LabelMove};
pub use facade::Library;
pub use history::Undone;
pub use jobs::JobFilter;
pub use linked::{LinkKind, PartName};
pub use links::{Link, LinkChanged, MAX_LINKED_SHAPES, MAX_LINKS};
pub use names::{check_shape_name, shown};
pub use points::{PointRequest, PolygonValues};
pub use proposals::{MIN_PROPOSED_SHAPES, ProposalInfo, Proposals, ProposedLabels};
pub use questions::{Answer, Answered, OfferedLabel, PartQuestion};
pub use reason::{Code, Reason};
pub use remote::{PlacementTicket, state_from_json, state_to_json};
pub use repair::Repaired;
pub use resolution::{InputPair, InputShape, Resolution};
pub use rows::{label_colour, report_to_json};
pub use submit::{Described, Describer, StoredOriginals, Submission};
pub use suggest::Suggestion;
pub use types::{
    CollectionInfo, CollectionSpec, Failure, FailureSubject, ItemState, Job, JobItem, LabelId,
    LabelInfo, Labels, LibraryStats, MapInfo, NewShape, Outcome, PartInfo, PartMatch, Placed,
    PropagationProgress, RequestKey, ShapeInfo, Source, Up, UpEstimate,
};
pub use upright::UpSet;
pub use verdict::{Review, ReviewState};
