//! Converts wire messages to domain values and back; no other module knows both.

mod analysis;
mod bundles;
mod checked;
mod collections;
mod corrections;
mod errors;
mod events;
mod jobs;
mod links;
mod proposals;
mod questions;
mod shapes;

pub use analysis::{
    agreement, descriptors, from_rows, functional_map, hks, hks_at, nearest, part_correspondence,
    point_maps, point_request, polygon_values, resolution, spectrum, spectrum_at, transferred,
};
pub use bundles::{array_file_digest, bundle_head, bundle_head_from_wire};
pub use checked::{
    MAX_LANDMARKS, MAX_PORTRAITS, NamedFrames, check_addition, check_correction, check_creation,
    check_hks, check_link, check_map, check_portraits, check_review, check_reviews, check_spectrum,
    check_transfer, check_update,
};
pub use collections::{
    collection, collection_differs, collection_spec, label_info, new_up, parse_up, up_from_wire,
    up_name, updated,
};
pub use corrections::{corrected, correction, suggested, undone};
pub use errors::{error, failure, field_error, frame_error, library_error, with_subject};
pub use events::event;
pub use jobs::{
    Ingest, ShapeInput, Source, add_shapes, carrying_job, format_from_wire, item, job_finished,
    mesh_format, new_shapes,
};
pub use links::{link, link_kind, linked, new_link, part_of_shape, unlinked};
pub use proposals::{chosen, proposals, proposed_labels};
pub use questions::{answer, answered, question, review, wanted_review};
pub use shapes::{clean_report, labels, labels_snapshot, original, shape};
