//! Counts the fields of an encoded message before it is decoded.
//!
//! Decoding can turn a field of two bytes into hundreds, for example an empty message in a list.
//! Therefore a limit on fields bounds the memory of a header, in addition to the limit on its
//! bytes.

/// Maximum number of fields of a header. The longest lists that a request may have stay far below.
pub const MAX_FIELDS: usize = 100_000;

/// Depth to which nested messages are examined; no field of a request is deeper.
const MAX_DEPTH: u32 = 6;

/// Number of fields of an encoded message, including nested messages; counting stops beyond
/// `limit`. Text and bytes that could be a message count as one, since no schema is known here.
pub fn count(message: &[u8], limit: usize) -> usize {
    let mut n = 0;
    walk(message, MAX_DEPTH, limit, &mut n);
    n
}

/// Adds the fields of `message` to `n`. Returns whether it consists of fields only.
fn walk(mut message: &[u8], depth: u32, limit: usize, n: &mut usize) -> bool {
    while !message.is_empty() {
        if *n > limit {
            return true;
        }
        let Some(key) = varint(&mut message) else {
            return false;
        };
        let length = match key & 7 {
            0 => match varint(&mut message) {
                Some(_) => 0,
                None => return false,
            },
            1 => 8,
            2 => match varint(&mut message) {
                Some(length) => length,
                None => return false,
            },
            // The ends of a group have no value.
            3 | 4 => 0,
            5 => 4,
            _ => return false,
        };
        let Some((value, rest)) = usize::try_from(length)
            .ok()
            .and_then(|length| message.split_at_checked(length))
        else {
            return false;
        };
        message = rest;
        *n += 1;
        if key & 7 == 2 && depth > 0 {
            let before = *n;
            if !walk(value, depth - 1, limit, n) {
                *n = before;
            }
        }
    }
    true
}

/// Reads the variable-length integer at the beginning of bytes, and removes it.
fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (byte, rest) = bytes.split_first()?;
        *bytes = rest;
        value |= u64::from(byte & 127) << shift;
        if byte & 128 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::{MAX_FIELDS, count};
    use crate::ipc::wire::{AddShapesRequest, Request, ShapeInput, request::Body};
    use prost::Message as _;

    fn addition(n: usize) -> Vec<u8> {
        let shapes = vec![ShapeInput::default(); n];
        let request = AddShapesRequest {
            collection: "chairs".to_owned(),
            shapes,
            ..Default::default()
        };
        let request = Request {
            request_id: "7".to_owned(),
            body: Some(Body::AddShapes(request)),
            ..Default::default()
        };
        request.encode_to_vec()
    }

    #[test]
    fn fields_of_messages_within_messages_count() {
        // The fields are the id, the body, the collection, and then each shape.
        assert_eq!(count(&addition(0), MAX_FIELDS), 3);
        assert_eq!(count(&addition(40), MAX_FIELDS), 43);
        assert!(count(&addition(2 * MAX_FIELDS), MAX_FIELDS) > MAX_FIELDS);
    }

    #[test]
    fn what_is_no_message_is_no_trouble() {
        for bytes in [
            &b""[..],
            b"\xff",
            b"\x0a",
            b"\x0a\xff\xff\xff\xff\x0f",
            b"\x07",
        ] {
            assert!(count(bytes, MAX_FIELDS) <= 1, "{bytes:?}");
        }
        // Endless nesting is followed to a limited depth only.
        let mut deep = Vec::new();
        for _ in 0..10_000 {
            let length = deep.len();
            let mut outer = vec![0x0a];
            prost::encoding::encode_varint(length as u64, &mut outer);
            outer.append(&mut deep);
            deep = outer;
        }
        assert!(count(&deep, MAX_FIELDS) < 10);
    }
}
