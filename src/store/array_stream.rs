//! Writes arrays to a safetensors file in pieces, so that none has to be in memory as a whole.

use super::array_file::header;
use safetensors::tensor::Dtype;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

/// A safetensors file with partly written arrays.
#[derive(Debug)]
pub struct ArrayStream {
    file: File,
    places: Vec<Place>,
}

/// The position of the data of an array.
#[derive(Debug)]
struct Place {
    begin: u64,
    length: u64,
}

impl ArrayStream {
    /// Creates a file, which replaces the one at `path`, with the header for arrays of these names,
    /// types and shapes, and zeros as their values.
    ///
    /// # Errors
    /// If the file cannot be created or extended to its length.
    pub fn create(path: &Path, arrays: &[(&str, Dtype, Vec<usize>)]) -> io::Result<Self> {
        let header = header(None, arrays.iter().map(|a| (a.0, a.1, a.2.as_slice())));
        let mut begin = header.len() as u64;
        let mut places = Vec::with_capacity(arrays.len());
        for (_, dtype, shape) in arrays {
            let length = (shape.iter().product::<usize>() * dtype.bitsize() / 8) as u64;
            places.push(Place { begin, length });
            begin += length;
        }
        let file = File::create(path)?;
        file.set_len(begin)?;
        file.write_all_at(&header, 0)?;
        Ok(Self { file, places })
    }

    /// Writes `values` to array `array` (in the order of [`ArrayStream::create`]), from its element
    /// `first` on.
    ///
    /// # Errors
    /// If the disk is full, or another error of the file occurs.
    ///
    /// # Panics
    /// If the values do not fit into the array.
    pub fn write<T: bytemuck::NoUninit>(
        &self,
        array: usize,
        first: usize,
        values: &[T],
    ) -> io::Result<()> {
        let place = &self.places[array];
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let offset = (first * size_of::<T>()) as u64;
        let end = offset + bytes.len() as u64;
        assert!(
            end <= place.length,
            "array {array} has {} bytes, but byte {end} was to be written",
            place.length
        );
        self.file.write_all_at(bytes, place.begin + offset)
    }
}

#[cfg(test)]
mod tests {
    use super::ArrayStream;
    use safetensors::SafeTensors;
    use safetensors::tensor::Dtype;

    #[test]
    fn arrays_arrive_in_any_order() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("arrays.safetensors");
        let arrays = [
            ("rows", Dtype::F64, vec![3, 2]),
            ("words", Dtype::U32, vec![4]),
            ("none", Dtype::F32, vec![0, 7]),
        ];
        let stream = ArrayStream::create(&path, &arrays).expect("created");
        stream.write(0, 4, &[5.0, 6.0]).expect("written");
        stream.write(1, 0, &[7u32, 8, 9, 10]).expect("written");
        stream.write(0, 0, &[1.0, 2.0, 3.0, 4.0]).expect("written");
        stream.write::<f32>(2, 0, &[]).expect("written");
        let bytes = std::fs::read(&path).expect("readable");
        let file = SafeTensors::deserialize(&bytes).expect("safetensors");
        let rows: Vec<f64> = (1..=6).map(f64::from).collect();
        assert_eq!(
            file.tensor("rows").expect("there").data(),
            bytemuck::cast_slice::<f64, u8>(&rows)
        );
        assert_eq!(file.tensor("rows").expect("there").shape(), [3, 2]);
        let words = [7u32, 8, 9, 10];
        assert_eq!(
            file.tensor("words").expect("there").data(),
            bytemuck::cast_slice::<u32, u8>(&words)
        );
        assert_eq!(file.tensor("none").expect("there").shape(), [0, 7]);
    }

    #[test]
    #[should_panic(expected = "array 0 has 8 bytes, but byte 16 was to be written")]
    fn nothing_is_written_beyond_an_array() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("arrays.safetensors");
        let arrays = [("a", Dtype::F64, vec![1]), ("b", Dtype::F64, vec![1])];
        let stream = ArrayStream::create(&path, &arrays).expect("created");
        let _ = stream.write(0, 1, &[1.0]);
    }
}
