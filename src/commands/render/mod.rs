//! `coseg render` draws a collection as one picture, with each shape in the colours of its labels.

mod canvas;
pub(crate) mod pair;
mod view;

use super::export::Original;
use super::export_mesh::{colour, styles};
use super::session::{Session, bar};
use super::{CommandError, Outcome, labels};
use crate::cli::Render;
use canvas::{Canvas, GLYPH};
use coseg::ipc::wire::{self, LabelInfo};
use coseg::mesh::ParsedMesh;
use coseg::text::counted;
use serde_json::json;
use view::View;

/// Width and height of a shape's square in pixels, without its name.
const CELL: usize = 240;
/// Margin in pixels.
const MARGIN: usize = 8;
/// Height of a line of text in pixels.
const LINE: usize = GLYPH + 6;
/// Ratio of columns to rows: sheets are wider than high.
const ASPECT: f64 = 1.5;

pub(crate) fn run(args: &Render, mut session: Session) -> Outcome {
    let collection = session.settled_collection(&args.of, args.no_wait)?;
    let about = session.describe(&collection)?;
    let mut shapes = session.shapes(&collection, None)?;
    if let Some(max) = args.max {
        shapes.truncate(max);
    }
    let up = about.spec.as_ref().and_then(|s| axis(s.up()));
    let progress = bar(shapes.len() as u64);
    let styles = styles(&about.labels);
    let mut cells = Vec::with_capacity(shapes.len());
    for shape in &shapes {
        progress.set_message(shape.name.clone());
        let request = wire::GetLabelsRequest {
            collection: collection.clone(),
            shape: shape.name.clone(),
            version: 0,
            confidence: false,
        };
        let found = labels::receive(&mut session, request)?.labels;
        let original = Original::receive(&mut session, &collection, &shape.name)?;
        let mesh = original.mesh(&shape.name, found.len())?;
        let colours: Vec<[u8; 3]> = found.iter().map(|&l| colour(l, &styles)).collect();
        cells.push(Cell {
            name: shape.name.clone(),
            picture: picture(&mesh, &colours, up),
        });
        progress.inc(1);
    }
    progress.finish_and_clear();
    let sheet = contact_sheet(&legend(&about.labels), &cells);
    let file = |source| CommandError::File {
        path: args.out.display().to_string(),
        source,
    };
    std::fs::write(&args.out, sheet.png().map_err(file)?).map_err(file)?;
    if session.json {
        session.print_json(&json!({
            "collection": collection,
            "file": args.out.display().to_string(),
            "width": sheet.width(),
            "height": sheet.height(),
            "n_shapes": shapes.len(),
        }))?;
    } else {
        let shapes = counted(shapes.len() as u64, "shape");
        eprintln!("{shapes} drawn to {}", args.out.display());
    }
    Ok(true)
}

/// A picture of a shape, and its name.
pub(in crate::commands) struct Cell {
    pub(in crate::commands) name: String,
    pub(in crate::commands) picture: Canvas,
}

/// Draws shapes side by side, below a legend: text and colour of each entry.
pub(in crate::commands) fn contact_sheet(legend: &[(String, [u8; 3])], cells: &[Cell]) -> Canvas {
    let n_columns = columns(cells.len());
    let n_rows = cells.len().div_ceil(n_columns);
    let width = n_columns * (CELL + MARGIN) + MARGIN;
    let top = MARGIN + LINE * legend_lines(legend, width);
    let mut sheet = Canvas::new(width, top + n_rows * (CELL + LINE + MARGIN) + MARGIN);
    draw_legend(&mut sheet, legend);
    for (i, cell) in cells.iter().enumerate() {
        let x = MARGIN + i % n_columns * (CELL + MARGIN);
        let y = top + i / n_columns * (CELL + LINE + MARGIN);
        sheet.put(x, y, &cell.picture);
        sheet.text(x, y + CELL + 2, &fitting(&cell.name, CELL), [40; 3]);
    }
    sheet
}

/// One shape in the colours of its polygons.
pub(in crate::commands) fn picture(
    mesh: &ParsedMesh,
    colours: &[[u8; 3]],
    up: Option<[f64; 3]>,
) -> Canvas {
    let view = View::new(&mesh.vertices, up);
    let corners = mesh
        .triangles
        .iter()
        .map(|t| t.map(|v| mesh.vertices[v as usize]));
    let painted = corners
        .zip(&mesh.polygon_of_triangle)
        .map(|(corners, polygon)| (corners, colours[*polygon as usize]));
    view.draw(CELL, painted)
}

/// A shape with some of its polygons in colour, as PNG.
pub(super) fn highlighted(
    mesh: &ParsedMesh,
    faces: &[u32],
    up: wire::Up,
) -> std::io::Result<Vec<u8>> {
    const REST: [u8; 3] = [200; 3];
    const CHOSEN: [u8; 3] = [230, 110, 0];
    let mut colours = vec![REST; mesh.n_polygons];
    for face in faces {
        if let Some(colour) = colours.get_mut(*face as usize) {
            *colour = CHOSEN;
        }
    }
    picture(mesh, &colours, axis(up)).png()
}

fn columns(n_shapes: usize) -> usize {
    ((n_shapes as f64 * ASPECT).sqrt().ceil() as usize).clamp(1, n_shapes.max(1))
}

/// Labels in use: text and colour of each.
fn legend(labels: &[LabelInfo]) -> Vec<(String, [u8; 3])> {
    let styles = styles(labels);
    let in_use = labels.iter().filter(|l| l.n_shapes > 0);
    in_use
        .filter_map(|l| i32::try_from(l.id).ok().zip(Some(&l.name)))
        .map(|(id, name)| {
            (
                format!("{id} {name}").trim_end().to_owned(),
                colour(id, &styles),
            )
        })
        .collect()
}

/// Width of an entry in pixels: a square, its text, a gap.
fn entry_width(text: &str) -> usize {
    GLYPH * (text.chars().count() + 4)
}

/// The position of each entry: column in pixels, and line.
fn places(legend: &[(String, [u8; 3])], width: usize) -> Vec<(usize, usize)> {
    let (mut x, mut line) = (MARGIN, 0);
    let place = |(text, _): &(String, [u8; 3])| {
        if x > MARGIN && x + entry_width(text) > width {
            (x, line) = (MARGIN, line + 1);
        }
        let at = (x, line);
        x += entry_width(text);
        at
    };
    legend.iter().map(place).collect()
}

fn legend_lines(legend: &[(String, [u8; 3])], width: usize) -> usize {
    places(legend, width).last().map_or(0, |(_, line)| line + 1)
}

fn draw_legend(sheet: &mut Canvas, legend: &[(String, [u8; 3])]) {
    for ((text, colour), (x, line)) in legend.iter().zip(places(legend, sheet.width())) {
        let y = MARGIN + line * LINE;
        sheet.fill(x, y, GLYPH * 3 / 2, GLYPH, *colour);
        sheet.text(x + 2 * GLYPH, y, text, [0; 3]);
    }
}

/// A name, shortened to fit.
fn fitting(name: &str, width: usize) -> String {
    let most = width / GLYPH;
    if name.chars().count() <= most {
        return name.to_owned();
    }
    let kept: String = name.chars().take(most.saturating_sub(2)).collect();
    format!("{kept}..")
}

pub(super) fn axis(up: wire::Up) -> Option<[f64; 3]> {
    Some(match up {
        wire::Up::PlusX => [1.0, 0.0, 0.0],
        wire::Up::MinusX => [-1.0, 0.0, 0.0],
        wire::Up::PlusY => [0.0, 1.0, 0.0],
        wire::Up::MinusY => [0.0, -1.0, 0.0],
        wire::Up::PlusZ => [0.0, 0.0, 1.0],
        wire::Up::MinusZ => [0.0, 0.0, -1.0],
        wire::Up::Unspecified | wire::Up::Unknown | wire::Up::Auto => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::{columns, entry_width, fitting, legend_lines, places};

    #[test]
    fn sheets_are_wider_than_high() {
        assert_eq!(
            (columns(0), columns(1), columns(2), columns(20)),
            (1, 1, 2, 6)
        );
    }

    #[test]
    fn a_legend_breaks_into_lines() {
        let legend: Vec<_> = (0..5).map(|i| (format!("{i} leg"), [0; 3])).collect();
        let width = 2 * entry_width("0 leg") + 20;
        let lines: Vec<usize> = places(&legend, width).iter().map(|p| p.1).collect();
        assert_eq!(lines, [0, 0, 1, 1, 2]);
        assert_eq!(
            (legend_lines(&legend, width), legend_lines(&[], width)),
            (3, 0)
        );
    }

    #[test]
    fn long_names_are_cut() {
        assert_eq!(fitting("chair", 80), "chair");
        assert_eq!(fitting("a very long chair", 80), "a very l..");
    }
}
