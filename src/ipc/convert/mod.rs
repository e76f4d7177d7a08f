//! Wire messages become domain values and back; no other module knows both.

mod analysis;
mod collections;
mod corrections;
mod errors;
mod events;
mod jobs;
mod shapes;

pub use analysis::{
    agreement, descriptors, functional_map, hks, nearest, part_correspondence, point_maps,
    point_request, polygon_values, spectrum, transferred,
};
pub use collections::{collection, collection_differs, collection_spec, label_info, up_from_wire};
pub use corrections::{corrected, correction, suggested, undone};
pub use errors::{
    error, failure, field_error, frame_error, library_error, library_failure, with_subject,
};
pub use events::event;
pub use jobs::{
    Ingest, add_shapes, carrying_job, format_from_wire, item, job_finished, mesh_format, new_shapes,
};
pub use shapes::{labels, labels_snapshot, original, report, shape};
