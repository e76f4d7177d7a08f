//! Draws two shapes and the map between them as one picture: the map transfers colours that encode
//! positions on the first shape to the second, and the entries of the functional map appear beside
//! them.

use super::canvas::Canvas;
use super::view::View;
use super::{CELL, LINE, MARGIN, fitting};
use crate::commands::CommandError;
use crate::commands::session::Session;
use coseg::call;
use coseg::ipc::wire::{self, ArrayRef};
use std::io;

/// A shape at working resolution.
pub(crate) struct Side {
    name: String,
    vertices: Vec<[f64; 3]>,
    faces: Vec<[u32; 3]>,
}

/// The data of the picture.
pub(crate) struct Sheet {
    /// Shape 1.
    pub(crate) from: Side,
    /// Shape 2.
    pub(crate) to: Side,
    /// `(rows, columns)`.
    pub(crate) c_12: Vec<f32>,
    /// Columns of `c_12`.
    pub(crate) columns: usize,
    /// For each vertex of shape 2 a vertex of shape 1.
    pub(crate) p2p_21: Vec<u32>,
}

impl Side {
    /// Requests the shape from the daemon.
    pub(crate) fn receive(
        session: &mut Session,
        collection: &str,
        shape: &str,
    ) -> Result<Self, CommandError> {
        let request = wire::GetDescriptorsRequest {
            collection: collection.to_owned(),
            shape: shape.to_owned(),
        };
        let (reply, frames) = call!(session.client, GetDescriptors(request), frames)?;
        let words = |array: &Option<ArrayRef>| {
            let frame = array.as_ref().and_then(|a| frames.get(a.frame as usize));
            let words = frame.map(|f| f.as_chunks::<4>().0.to_vec());
            words.unwrap_or_default()
        };
        let vertices = words(&reply.vertices);
        let faces = words(&reply.faces);
        Ok(Self {
            name: shape.to_owned(),
            vertices: vertices
                .chunks_exact(3)
                .map(|v| [0, 1, 2].map(|i| f64::from(f32::from_le_bytes(v[i]))))
                .collect(),
            faces: faces
                .chunks_exact(3)
                .map(|f| [0, 1, 2].map(|i| u32::from_le_bytes(f[i])))
                .collect(),
        })
    }

    /// Red, green and blue for the three coordinates, over the bounding box of the shape.
    fn colours(&self) -> Vec<[f64; 3]> {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for v in &self.vertices {
            for i in 0..3 {
                low[i] = low[i].min(v[i]);
                high[i] = high[i].max(v[i]);
            }
        }
        let level = |v: &[f64; 3], i: usize| {
            40.0 + 200.0 * (v[i] - low[i]) / (high[i] - low[i]).max(1e-300)
        };
        self.vertices
            .iter()
            .map(|v| [0, 1, 2].map(|i| level(v, i)))
            .collect()
    }

    fn picture(&self, colours: &[[f64; 3]]) -> Canvas {
        let painted = self.faces.iter().map(|f| {
            let corners = f.map(|v| self.vertices[v as usize]);
            let of = f.map(|v| colours[v as usize]);
            let mean = [0, 1, 2].map(|i| ((of[0][i] + of[1][i] + of[2][i]) / 3.0).round() as u8);
            (corners, mean)
        });
        View::new(&self.vertices, None).draw(CELL, painted)
    }
}

impl Sheet {
    /// The picture as a PNG file.
    ///
    /// # Errors
    /// If the map does not fit these shapes.
    pub(crate) fn png(&self) -> io::Result<Vec<u8>> {
        let colours = self.from.colours();
        let carried: Option<Vec<[f64; 3]>> = self
            .p2p_21
            .iter()
            .map(|t| colours.get(*t as usize).copied())
            .collect();
        let carried = carried
            .filter(|c| c.len() == self.to.vertices.len())
            .ok_or_else(|| io::Error::other("the map is not one between these shapes"))?;
        let step = CELL + MARGIN;
        let mut sheet = Canvas::new(3 * step + MARGIN, CELL + LINE + 2 * MARGIN);
        sheet.put(MARGIN, MARGIN, &self.from.picture(&colours));
        sheet.put(MARGIN + step, MARGIN, &self.to.picture(&carried));
        sheet.put(MARGIN + 2 * step, MARGIN, &heat(&self.c_12, self.columns));
        let texts = [self.from.name.as_str(), self.to.name.as_str(), "|c_12|"];
        for (i, text) in texts.into_iter().enumerate() {
            let text = fitting(text, CELL);
            sheet.text(MARGIN + i * step, MARGIN + CELL + 2, &text, [40; 3]);
        }
        sheet.png()
    }
}

/// Magnitudes of the entries: white is 0, black is 1 and more.
fn heat(c: &[f32], columns: usize) -> Canvas {
    let rows = c.len() / columns.max(1);
    let pixel = |at: usize| {
        let (x, y) = (at % CELL * columns / CELL, at / CELL * rows / CELL);
        let value = c.get(y * columns + x).map_or(0.0, |v| v.abs().min(1.0));
        let shade = (255.0 * (1.0 - value.sqrt())).round() as u8;
        [shade, shade, shade.saturating_add((value * 60.0) as u8)]
    };
    Canvas::of_pixels(CELL, (0..CELL * CELL).map(pixel).collect())
}

#[cfg(test)]
mod tests {
    use super::{CELL, Sheet, Side, heat};

    fn tetrahedron(name: &str) -> Side {
        Side {
            name: name.to_owned(),
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
        }
    }

    #[test]
    fn a_map_is_drawn_and_a_wrong_one_refused() {
        let sheet = |p2p_21| Sheet {
            from: tetrahedron("a"),
            to: tetrahedron("b"),
            c_12: vec![1.0, 0.0, 0.0, 1.0],
            columns: 2,
            p2p_21,
        };
        assert_eq!(&sheet(vec![0, 1, 2, 3]).png().unwrap()[1..4], b"PNG");
        assert!(sheet(vec![0, 1, 2]).png().is_err());
        assert!(sheet(vec![0, 1, 2, 9]).png().is_err());
        let same = heat(&[1.0, 0.0, 0.0, 1.0], 2);
        assert_eq!((same.width(), same.height()), (CELL, CELL));
    }
}
