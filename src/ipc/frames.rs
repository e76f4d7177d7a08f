//! Splits multipart messages into a header and raw frames, and resolves array references to slices
//! of frames.
//!
//! Counts and lengths are compared with the limits and with the number of received bytes before
//! memory is reserved for them.

use crate::ipc::wire::{ArrayRef, BytesRef, DataType, ErrorReason};
use bytes::Bytes;

/// The limits of one message; see `Limits` in `proto/coseg/v1/daemon.proto`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameLimits {
    /// Maximum size of all frames together.
    pub max_message_bytes: u64,
    /// Maximum number of raw frames after the header.
    pub max_frames: usize,
    /// Maximum size of the header frame.
    pub max_header_bytes: u64,
}

/// The reason why a message, or an array in it, cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)]
pub enum FrameError {
    #[error("{}", too_large(what, *found, *limit))]
    TooLarge {
        what: &'static str,
        found: u64,
        limit: u64,
    },
    #[error("the message has no header frame")]
    NoHeader,
    #[error("{field} is missing")]
    Missing { field: String },
    #[error("{field} names frame {frame}, but the message has {n_frames}")]
    NoFrame {
        field: String,
        frame: u32,
        n_frames: usize,
    },
    #[error("{field} has shape {shape:?} and needs {needed} bytes, but its frame has {found}")]
    Length {
        field: String,
        shape: Vec<u64>,
        needed: u64,
        found: u64,
    },
    #[error("{field} has shape {shape:?}, which overflows")]
    Overflow { field: String, shape: Vec<u64> },
    #[error("{field} has element type {found}, expected {expected}")]
    Type {
        field: String,
        found: i32,
        expected: &'static str,
    },
    #[error("{field} has {found} axes, expected {expected}")]
    Axes {
        field: String,
        found: usize,
        expected: usize,
    },
}

impl FrameError {
    /// The reason on the wire.
    pub fn reason(&self) -> ErrorReason {
        match self {
            Self::TooLarge { .. } => ErrorReason::MessageTooLarge,
            Self::NoHeader => ErrorReason::MalformedMessage,
            Self::Missing { .. } => ErrorReason::FieldMissing,
            Self::NoFrame { .. } => ErrorReason::FrameMissing,
            Self::Length { .. } | Self::Overflow { .. } => ErrorReason::FrameLength,
            Self::Type { .. } | Self::Axes { .. } => ErrorReason::FieldRange,
        }
    }

    /// The field that the error concerns.
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::TooLarge { .. } | Self::NoHeader => None,
            Self::Missing { field }
            | Self::NoFrame { field, .. }
            | Self::Length { field, .. }
            | Self::Overflow { field, .. }
            | Self::Type { field, .. }
            | Self::Axes { field, .. } => Some(field),
        }
    }
}

/// The message that `what` has `found` items, more than `limit`.
pub(super) fn too_large(what: &str, found: u64, limit: u64) -> String {
    match what {
        "bytes" => super::size::beyond("the message", found, limit, "limits.max_message"),
        _ => format!("the message has {found} {what}, the limit is {limit}"),
    }
}

/// A message's frames; or, if it was too large, its first frames and the reason for dropping it.
pub type Received = Result<Vec<Bytes>, (Vec<Bytes>, FrameError)>;

/// A received frame that owns ZeroMQ's memory, so that it is not copied.
struct OwnedFrame(zmq::Message);

impl AsRef<[u8]> for OwnedFrame {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

/// Receives all frames of one message. The outer error is the socket's; the inner one means that
/// the message was too large and was dropped, and contains its first frames (at most `n_kept`) for
/// an answer.
pub fn receive(
    socket: &zmq::Socket,
    flags: i32,
    limits: &FrameLimits,
    n_kept: usize,
) -> Result<Received, zmq::Error> {
    receive_from(socket, flags, limits, n_kept).map(|(_, received)| received)
}

/// Like [`receive`], and also returns the sender if the connection is authenticated.
pub fn receive_from(
    socket: &zmq::Socket,
    flags: i32,
    limits: &FrameLimits,
    n_kept: usize,
) -> Result<(Option<String>, Received), zmq::Error> {
    let mut user = None;
    let mut frames = Vec::new();
    let mut excess = None;
    let (mut n_frames, mut n_bytes) = (0_usize, 0_u64);
    // Routing frames and the header are not raw frames.
    let max_parts = limits.max_frames.saturating_add(n_kept);
    loop {
        let mut part = socket.recv_msg(if n_frames == 0 { flags } else { 0 })?;
        // The id is taken from the last frame: every frame has it except, on some sockets, the
        // routing frame.
        user = part.gets("User-Id").map(str::to_owned).or(user);
        let more = part.get_more();
        n_frames += 1;
        n_bytes = n_bytes.saturating_add(part.len() as u64);
        if n_frames > max_parts {
            excess = Some(FrameError::TooLarge {
                what: "frames",
                found: (n_frames - n_kept) as u64,
                limit: limits.max_frames as u64,
            });
        } else if n_bytes > limits.max_message_bytes {
            excess = Some(FrameError::TooLarge {
                what: "bytes",
                found: n_bytes,
                limit: limits.max_message_bytes,
            });
        }
        if excess.is_none() || frames.len() < n_kept {
            frames.push(Bytes::from_owner(OwnedFrame(part)));
        }
        if let Some(error) = excess.take_if(|_| !more) {
            frames.truncate(n_kept);
            return Ok((user, Err((frames, error))));
        }
        if !more {
            return Ok((user, Ok(frames)));
        }
    }
}

/// Sends all frames as one message. With `flags` [`zmq::DONTWAIT`] either all or none are sent.
pub fn send(socket: &zmq::Socket, parts: Vec<zmq::Message>, flags: i32) -> Result<(), zmq::Error> {
    let last = parts.len().saturating_sub(1);
    for (i, part) in parts.into_iter().enumerate() {
        socket.send(
            part,
            if i < last {
                flags | zmq::SNDMORE
            } else {
                flags
            },
        )?;
    }
    Ok(())
}

/// Collects the raw frames of a new message.
#[derive(Debug, Default)]
pub struct FrameWriter {
    frames: Vec<Bytes>,
}

macro_rules! array_writer {
    ($name:ident, $element:ty, $dtype:expr) => {
        /// Appends an array, row-major; `shape` must hold exactly `data`.
        pub fn $name(&mut self, data: &[$element], shape: &[usize]) -> ArrayRef {
            debug_assert_eq!(data.len(), shape.iter().product::<usize>());
            let mut bytes = Vec::with_capacity(std::mem::size_of_val(data));
            for value in data {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
            self.array($dtype, shape, bytes)
        }
    };
}

impl FrameWriter {
    array_writer!(i32_array, i32, DataType::Int32);
    array_writer!(u32_array, u32, DataType::Uint32);
    array_writer!(f32_array, f32, DataType::Float32);
    array_writer!(f64_array, f64, DataType::Float64);

    fn array(&mut self, dtype: DataType, shape: &[usize], bytes: Vec<u8>) -> ArrayRef {
        let shape = shape.iter().map(|&n| n as u64).collect();
        ArrayRef {
            dtype: dtype.into(),
            shape,
            frame: self.push(bytes.into()),
        }
    }

    /// Appends the bytes of a file.
    pub fn file(&mut self, bytes: impl Into<Bytes>) -> BytesRef {
        BytesRef {
            frame: self.push(bytes.into()),
        }
    }

    fn push(&mut self, bytes: Bytes) -> u32 {
        self.frames.push(bytes);
        u32::try_from(self.frames.len() - 1).expect("invariant: fewer than 2^32 frames")
    }

    /// The frames, in order.
    pub fn finish(self) -> Vec<Bytes> {
        self.frames
    }
}

/// Reads arrays and files from the raw frames of a received message.
#[derive(Debug, Clone, Copy)]
pub struct FrameReader<'a> {
    frames: &'a [Bytes],
}

/// Elements of an array whose type was checked.
type Elements<T> = Result<(Vec<T>, Vec<usize>), FrameError>;

macro_rules! array_reader {
    ($name:ident, $element:ty, $dtypes:pat, $expected:literal) => {
        /// The array's elements, row-major, and its shape.
        pub fn $name(&self, array: Option<&ArrayRef>, field: &str) -> Elements<$element> {
            let (dtype, shape, frame) = self.array(array, field)?;
            match dtype {
                $dtypes => {}
                _ => {
                    return Err(FrameError::Type {
                        field: field.to_owned(),
                        found: dtype.into(),
                        expected: $expected,
                    });
                }
            }
            let (elements, _) = frame.as_chunks();
            Ok((
                elements
                    .iter()
                    .map(|e| <$element>::from_le_bytes(*e))
                    .collect(),
                shape,
            ))
        }
    };
}

impl<'a> FrameReader<'a> {
    /// Reads the raw frames, without the header.
    pub fn new(frames: &'a [Bytes]) -> Self {
        Self { frames }
    }

    array_reader!(i32_array, i32, DataType::Int32, "int32");
    array_reader!(u32_array, u32, DataType::Uint32, "uint32");
    array_reader!(f32_array, f32, DataType::Float32, "float32");
    array_reader!(f64_array, f64, DataType::Float64, "float64");
    // A negative index becomes larger than any count, so the range check finds it.
    array_reader!(
        index_array,
        u32,
        DataType::Uint32 | DataType::Int32,
        "uint32 or int32"
    );

    /// Coordinates of either precision.
    pub fn coordinate_array(&self, array: Option<&ArrayRef>, field: &str) -> Elements<f64> {
        match array.map(ArrayRef::dtype) {
            Some(DataType::Float32) => {
                let (values, shape) = self.f32_array(array, field)?;
                Ok((values.into_iter().map(f64::from).collect(), shape))
            }
            _ => self.f64_array(array, field),
        }
    }

    /// The bytes of a file.
    pub fn file(&self, file: Option<&BytesRef>, field: &str) -> Result<&'a Bytes, FrameError> {
        let file = file.ok_or_else(|| FrameError::Missing {
            field: field.to_owned(),
        })?;
        self.frame(file.frame, field)
    }

    fn frame(&self, frame: u32, field: &str) -> Result<&'a Bytes, FrameError> {
        self.frames
            .get(frame as usize)
            .ok_or_else(|| FrameError::NoFrame {
                field: field.to_owned(),
                frame,
                n_frames: self.frames.len(),
            })
    }

    fn array(
        &self,
        array: Option<&ArrayRef>,
        field: &str,
    ) -> Result<(DataType, Vec<usize>, &'a Bytes), FrameError> {
        let array = array.ok_or_else(|| FrameError::Missing {
            field: field.to_owned(),
        })?;
        let frame = self.frame(array.frame, field)?;
        let element = match array.dtype() {
            DataType::Int32 | DataType::Uint32 | DataType::Float32 => 4_u64,
            DataType::Float64 => 8,
            DataType::Unspecified => {
                return Err(FrameError::Type {
                    field: field.to_owned(),
                    found: array.dtype,
                    expected: "one of DataType",
                });
            }
        };
        let overflow = || FrameError::Overflow {
            field: field.to_owned(),
            shape: array.shape.clone(),
        };
        let needed = array
            .shape
            .iter()
            .try_fold(element, |product, &extent| product.checked_mul(extent))
            .ok_or_else(overflow)?;
        if needed != frame.len() as u64 {
            return Err(FrameError::Length {
                field: field.to_owned(),
                shape: array.shape.clone(),
                needed,
                found: frame.len() as u64,
            });
        }
        let shape = array
            .shape
            .iter()
            .map(|&n| usize::try_from(n).map_err(|_| overflow()));
        Ok((array.dtype(), shape.collect::<Result<_, _>>()?, frame))
    }
}

#[cfg(test)]
mod tests {
    use super::{FrameError, FrameLimits, FrameReader, FrameWriter, receive, send};
    use crate::ipc::wire::{ArrayRef, DataType};

    #[test]
    fn arrays_survive_the_way() {
        let mut writer = FrameWriter::default();
        let a = writer.f64_array(&[1.5, -2.5], &[2, 1]);
        let b = writer.i32_array(&[-1, 7, 8], &[3]);
        let c = writer.file(vec![9_u8]);
        let frames = writer.finish();
        let reader = FrameReader::new(&frames);
        assert_eq!(
            reader.f64_array(Some(&a), "a"),
            Ok((vec![1.5, -2.5], vec![2, 1]))
        );
        assert_eq!(
            reader.i32_array(Some(&b), "b"),
            Ok((vec![-1, 7, 8], vec![3]))
        );
        assert_eq!(reader.file(Some(&c), "c").unwrap().as_ref(), [9]);
        assert_eq!(frames[0].as_ref()[..8], 1.5_f64.to_le_bytes());
    }

    #[test]
    fn lying_references_are_refused() {
        let frames = [bytes::Bytes::from(vec![0_u8; 12])];
        let reader = FrameReader::new(&frames);
        let array = |shape: &[u64], frame, dtype: DataType| ArrayRef {
            dtype: dtype.into(),
            shape: shape.to_vec(),
            frame,
        };
        let read = |a: &ArrayRef| reader.f32_array(Some(a), "x");
        assert!(read(&array(&[3], 0, DataType::Float32)).is_ok());
        assert!(matches!(
            read(&array(&[4], 0, DataType::Float32)),
            Err(FrameError::Length { .. })
        ));
        assert!(matches!(
            read(&array(&[u64::MAX, u64::MAX], 0, DataType::Float32)),
            Err(FrameError::Overflow { .. })
        ));
        assert!(matches!(
            read(&array(&[3], 1, DataType::Float32)),
            Err(FrameError::NoFrame { .. })
        ));
        assert!(matches!(
            read(&array(&[3], 0, DataType::Int32)),
            Err(FrameError::Type { .. })
        ));
        assert!(matches!(
            read(&array(&[3], 0, DataType::Unspecified)),
            Err(FrameError::Type { .. })
        ));
        assert!(matches!(
            reader.f32_array(None, "x"),
            Err(FrameError::Missing { .. })
        ));
    }

    #[test]
    fn messages_over_the_limit_are_dropped_and_the_next_one_arrives() {
        let context = zmq::Context::new();
        let (a, b) = (
            context.socket(zmq::PAIR).unwrap(),
            context.socket(zmq::PAIR).unwrap(),
        );
        a.bind("inproc://frames").unwrap();
        b.connect("inproc://frames").unwrap();
        let limits = FrameLimits {
            max_message_bytes: 10,
            max_frames: 2,
            max_header_bytes: 10,
        };
        let message = |sizes: &[usize]| {
            send(
                &b,
                sizes
                    .iter()
                    .map(|&n| zmq::Message::from(vec![1_u8; n]))
                    .collect(),
                0,
            )
            .unwrap();
            receive(&a, 0, &limits, 1).unwrap()
        };
        assert_eq!(message(&[4, 3, 3]).unwrap().len(), 3);
        let (kept, error) = message(&[4, 3, 4]).unwrap_err();
        assert_eq!((kept.len(), kept[0].len()), (1, 4));
        assert_eq!(
            error.to_string(),
            "the message has 11 bytes, the limit is 10 bytes (limits.max_message of the daemon's \
             configuration)"
        );
        let (_, error) = message(&[1, 1, 1, 1]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the message has 3 frames, the limit is 2"
        );
        assert_eq!(message(&[1]).unwrap().len(), 1);
    }
}
