//! Builds a library of generated chairs with labels, without a daemon: `cargo run --release
//! --example library`.

use coseg::library::{CollectionSpec, NewShape, Up};
use coseg::mesh::{Format, write::off};
use coseg::synth::{Family, Options, family};
use coseg::{Library, library::LibraryError};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::temp_dir().join(format!("coseg-example-{}", std::process::id()));
    let labelled = label(&folder);
    std::fs::remove_dir_all(&folder)?;
    Ok(labelled?)
}

fn label(folder: &std::path::Path) -> Result<(), LibraryError> {
    let library = Library::open(folder)?;
    let spec = CollectionSpec {
        name: "chairs".to_owned(),
        n_parts: Some(4),
        up: Up::PlusY,
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None)?;
    let options = Options {
        n_faces: 1_000,
        rotate: false,
    };
    for chair in family(Family::Chair, 1, 5, &options) {
        let shape = NewShape {
            name: chair.name.clone(),
            bytes: off(&chair.mesh).into_bytes(),
            format: Format::Off,
            replace: false,
        };
        let placed = library.add("chairs", shape)?;
        println!("{}: version {} of its labels", chair.name, placed.version);
    }
    for shape in library.shapes("chairs", 0, usize::MAX, None)? {
        let labels = library.labels("chairs", &shape.name, None)?;
        let parts: Vec<String> = shape
            .parts
            .iter()
            .map(|p| format!("label {} on {:.0} %", p.label, 100.0 * p.area_share))
            .collect();
        println!(
            "{}: {} faces, {}",
            shape.name,
            labels.labels.len(),
            parts.join(", ")
        );
    }
    Ok(())
}
