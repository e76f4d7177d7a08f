//! The pipe between the daemon and a worker: frames with their lengths.

use bytes::{Buf as _, Bytes};
use std::io::{self, Read, Write as _};

/// The subcommand that is a worker.
pub const WORKER_COMMAND: &str = "worker";
/// Bytes of the longest frame from a worker: a description of the largest file is shorter.
const MAX_FRAME: u64 = 4 << 30;
/// Memory that a worker may hold beyond the estimate for its work: for what the allocator keeps,
/// and for meshes whose spectrum has thousands of equal eigenvalues.
pub(super) const MEMORY_MARGIN: u64 = 768 << 20;

/// Kinds of frames from a worker.
pub(super) const READY: u8 = b'r';
pub(super) const STAGE: u8 = b's';
pub(super) const OUTCOME: u8 = b'o';

/// Joins pieces, each after its length.
pub(super) fn join_pieces<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<u8> {
    let mut out = Vec::new();
    for piece in pieces {
        out.extend_from_slice(&(piece.len() as u64).to_le_bytes());
        out.extend_from_slice(piece);
    }
    out
}

/// Splits what [`join_pieces`] made, without copying.
pub(super) fn split_pieces(joined: Vec<u8>) -> io::Result<Vec<Bytes>> {
    let mut rest = Bytes::from(joined);
    let mut pieces = Vec::new();
    while !rest.is_empty() {
        let length = rest.try_get_u64_le().map_err(io::Error::other)?;
        let length = usize::try_from(length).ok().filter(|n| *n <= rest.len());
        pieces.push(rest.split_to(length.ok_or(io::ErrorKind::UnexpectedEof)?));
    }
    Ok(pieces)
}

fn read_u64(input: &mut impl Read) -> io::Result<u64> {
    let mut bytes = [0; 8];
    input.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

pub(super) fn read_bytes(input: &mut impl Read) -> io::Result<Vec<u8>> {
    let length = read_u64(input)?;
    if length > MAX_FRAME {
        return Err(io::Error::other(format!("a frame of {length} bytes")));
    }
    let mut bytes = Vec::new();
    // Not allocated before it has arrived.
    input.take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length {
        Ok(bytes)
    } else {
        Err(io::ErrorKind::UnexpectedEof.into())
    }
}

pub(super) fn read_frame(input: &mut impl Read) -> io::Result<(u8, Vec<u8>)> {
    let mut kind = [0];
    input.read_exact(&mut kind)?;
    Ok((kind[0], read_bytes(input)?))
}

/// Writes a frame to the daemon.
pub(super) fn write_frame(kind: u8, bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(&[kind])?;
    out.write_all(&(bytes.len() as u64).to_le_bytes())?;
    out.write_all(bytes)?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::{join_pieces, split_pieces};

    #[test]
    fn joined_pieces_are_split_and_cut_ones_refused() {
        let pieces: [&[u8]; 3] = [b"a header", b"", &[7; 300]];
        let whole = join_pieces(pieces);
        assert_eq!(split_pieces(whole.clone()).unwrap(), pieces);
        assert!(split_pieces(Vec::new()).unwrap().is_empty());
        let cut = (0..whole.len()).filter(|end| split_pieces(whole[..*end].to_vec()).is_ok());
        // Between two pieces nothing is missing.
        assert_eq!(cut.collect::<Vec<_>>(), [0, 16, 24]);
    }
}
