//! Safe calls of what the patches of `../zmq-sys` add to libzmq: bounds of what peers can make a bound socket hold,
//! and the end of one connection; and frames whose owner learns when libzmq lets go of them.

use std::ffi::{c_int, c_void};

const MAX_FD: c_int = 1001;
const DROP_PEER: c_int = 1002;
const MAX_FRAMES: c_int = 1003;
const MAX_HELD: c_int = 1004;
const HELD: c_int = 1005;
const MAX_SUBSCRIPTIONS: c_int = 1006;
const MAX_SUBSCRIBED: c_int = 1007;
const DROPPED: c_int = 1008;
/// Bytes from which the C library takes an allocation from the system, and gives it back when it is freed.
const MAPPED_FROM: c_int = 128 << 10;

/// What the peers of a bound socket can make it hold; 0: no bound.
#[derive(Debug, Clone, Copy, Default)]
pub struct Bounds {
    /// Connections whose descriptors would not be below this are closed at once.
    pub max_fd: i32,
    /// Frames of one message; beyond, the connection is dropped.
    pub max_frames: i32,
    /// Bytes that arrived and were not received yet, of all peers; beyond, connections are dropped that hold most for
    /// longest.
    pub max_held: i64,
    /// Subscriptions of one peer; beyond, the connection is dropped.
    pub max_subscriptions: i32,
    /// Bytes that the subscriptions of all peers take, at worst; no peer may take more than it leaves.
    pub max_subscribed: i64,
}

/// Sets the bounds, before the socket is bound.
pub fn set_bounds(socket: &mut zmq::Socket, bounds: &Bounds) -> zmq::Result<()> {
    set(socket, MAX_FD, &bounds.max_fd.to_ne_bytes())?;
    set(socket, MAX_FRAMES, &bounds.max_frames.to_ne_bytes())?;
    set(socket, MAX_HELD, &bounds.max_held.to_ne_bytes())?;
    set(
        socket,
        MAX_SUBSCRIPTIONS,
        &bounds.max_subscriptions.to_ne_bytes(),
    )?;
    set(socket, MAX_SUBSCRIBED, &bounds.max_subscribed.to_ne_bytes())
}

/// Bytes that arrived and were not received yet.
pub fn held(socket: &mut zmq::Socket) -> zmq::Result<u64> {
    get(socket, HELD)
}

/// Connections that were dropped because of the bounds.
pub fn dropped(socket: &mut zmq::Socket) -> zmq::Result<u64> {
    get(socket, DROPPED)
}

/// Ends the connection of a peer of a ROUTER socket, with all that waits for it, between messages.
pub fn drop_peer(router: &mut zmq::Socket, identity: &[u8]) -> zmq::Result<()> {
    set(router, DROP_PEER, identity)
}

fn set(socket: &mut zmq::Socket, option: c_int, value: &[u8]) -> zmq::Result<()> {
    // SAFETY: the socket is open for as long as it is borrowed, and libzmq copies what it reads.
    let rc = unsafe {
        zmq_sys::zmq_setsockopt(
            socket.as_mut_ptr(),
            option,
            value.as_ptr().cast::<c_void>(),
            value.len(),
        )
    };
    checked(rc)
}

fn get(socket: &mut zmq::Socket, option: c_int) -> zmq::Result<u64> {
    let mut value = 0_i64;
    let mut length = size_of::<i64>();
    // SAFETY: the socket is open, and libzmq writes no more than `length` bytes.
    let rc = unsafe {
        zmq_sys::zmq_getsockopt(
            socket.as_mut_ptr(),
            option,
            (&raw mut value).cast::<c_void>(),
            &raw mut length,
        )
    };
    checked(rc).map(|()| u64::try_from(value).unwrap_or(0))
}

fn checked(rc: c_int) -> zmq::Result<()> {
    if rc != -1 {
        return Ok(());
    }
    // SAFETY: it reads a variable of this thread.
    Err(zmq::Error::from_raw(unsafe { zmq_sys::zmq_errno() }))
}

/// Sends a frame without copying it. `owner` is dropped, by whatever thread, when libzmq needs it no more: when it is
/// sent, when the connection ends, or at once if it cannot be sent.
pub fn send_owned<T: AsRef<[u8]> + Send + 'static>(
    socket: &mut zmq::Socket,
    owner: T,
    flags: i32,
) -> zmq::Result<()> {
    let owner = Box::new(owner);
    let bytes: &[u8] = (*owner).as_ref();
    let (data, length) = (bytes.as_ptr(), bytes.len());
    let hint = Box::into_raw(owner);
    let mut message = zmq_sys::zmq_msg_t::default();
    // SAFETY: `data` stays where it is until `let_go` drops its owner, which libzmq calls exactly once; libzmq does not
    // write to frames that it sends.
    let rc = unsafe {
        zmq_sys::zmq_msg_init_data(
            &mut message,
            data.cast_mut().cast::<c_void>(),
            length,
            Some(let_go::<T>),
            hint.cast::<c_void>(),
        )
    };
    if rc == -1 {
        // SAFETY: libzmq did not take it.
        drop(unsafe { Box::from_raw(hint) });
        return checked(rc);
    }
    // SAFETY: the message was initialised, and the socket is open.
    let sent = checked(unsafe {
        zmq_sys::zmq_msg_send(&mut message, socket.as_mut_ptr(), flags as c_int)
    });
    if sent.is_err() {
        // SAFETY: a message that was not sent is still the caller's. What this says is of no use.
        let _ = unsafe { zmq_sys::zmq_msg_close(&mut message) };
    }
    sent
}

/// Drops what `send_owned` was given.
unsafe extern "C" fn let_go<T>(_data: *mut c_void, hint: *mut c_void) {
    // SAFETY: `hint` is the box of `send_owned`, and this is called once for it.
    drop(unsafe { Box::from_raw(hint.cast::<T>()) });
}

/// Makes the C library, which libzmq takes its memory from, give back what was freed.
pub fn give_back_freed_memory() {
    #[cfg(target_env = "gnu")]
    // SAFETY: both calls take numbers and may be made at any time. Where a setting is refused, it stays as it was.
    unsafe {
        // Once it is set, it does not grow by itself.
        libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_FROM);
        libc::malloc_trim(0);
    }
}
