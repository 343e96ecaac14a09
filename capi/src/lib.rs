//! libcorotate: a program in C or C++ takes a role of a run.
//!
//! A call returns a number: 0 or more if it succeeded, less if it failed; [`corotate_last_error`] then has the sentence. A seat is a
//! number, so that a closed one is refused and never used. Nothing here may panic into C, or use memory that C has not named.

mod description;
mod error;
mod seat;

use error::SeatError;
use seat::Seat;
use std::cell::RefCell;
use std::collections::HashMap;
use std::ffi::{CStr, CString, OsStr, c_char, c_int, c_void};
use std::os::unix::ffi::OsStrExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

/// The version of this interface. A library of another version may have other functions or other meanings.
pub const COROTATE_ABI_VERSION: u32 = 1;
/// The call succeeded; for `corotate_seat_wait`, the run has ended.
pub const COROTATE_OK: c_int = 0;
/// `corotate_seat_wait`: a tick is under way.
pub const COROTATE_TICK: c_int = 1;
/// `corotate_seat_read`: the sample of this tick is missing or was rejected.
pub const COROTATE_MISSING: c_int = 2;
/// An argument is null, or a text is not UTF-8.
pub const COROTATE_BAD_ARGUMENT: c_int = -1;
/// The seat is not open.
pub const COROTATE_CLOSED: c_int = -2;
/// Another thread uses the seat.
pub const COROTATE_BUSY: c_int = -3;
/// The call is not possible now: no tick is under way, or the run has ended.
pub const COROTATE_WRONG_ORDER: c_int = -4;
/// The seat does not exist, or cannot be read.
pub const COROTATE_NO_SEAT: c_int = -5;
/// The run's program cannot be started.
pub const COROTATE_CANNOT_START: c_int = -6;
/// The role has no signal or input of this name.
pub const COROTATE_NO_SUCH_NAME: c_int = -7;
/// The size is not that of the sample, or the count is not that of the input.
pub const COROTATE_WRONG_SIZE: c_int = -8;
/// The run has ended with an error.
pub const COROTATE_RUN_FAILED: c_int = -9;
/// A defect of this library.
pub const COROTATE_DEFECT: c_int = -10;

/// The number of a seat; never 0.
#[allow(non_camel_case_types, reason = "the name in C")]
pub type corotate_seat = u64;

/// The open seats by their numbers, and the last number given.
static SEATS: Mutex<Option<Seats>> = Mutex::new(None);
type Seats = (HashMap<u64, Arc<Mutex<Seat>>>, u64);

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
}

/// Returns the version of this interface.
#[allow(unsafe_code, reason = "a name that C can link")]
#[unsafe(no_mangle)]
pub extern "C" fn corotate_abi_version() -> u32 {
    COROTATE_ABI_VERSION
}

/// Returns the sentence about this thread's last call that failed. It is valid until this thread's next call.
#[allow(unsafe_code, reason = "a name that C can link")]
#[unsafe(no_mangle)]
pub extern "C" fn corotate_last_error() -> *const c_char {
    LAST_ERROR.with(|error| error.try_borrow().map_or(c"".as_ptr(), |error| error.as_ptr()))
}

/// Takes the seat of a role and writes its number to `seat`. `path` is the seat's file, which the waiting run prints, or the directory
/// of the run; both texts end with NUL.
///
/// # Safety
/// The pointers are null or point to objects of their types.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_open(
    path: *const c_char,
    role: *const c_char,
    seat: *mut corotate_seat,
) -> c_int {
    guarded(|| {
        if seat.is_null() {
            return Err(SeatError::Null);
        }
        // SAFETY: the caller passes texts.
        let (path, role) = unsafe { (bytes(path)?, text(role)?) };
        let opened = Seat::open(Path::new(OsStr::from_bytes(path)), role)?;
        let mut seats = seats();
        let (open, last) = seats.get_or_insert_default();
        *last += 1;
        open.insert(*last, Arc::new(Mutex::new(opened)));
        // SAFETY: the pointer is not null, and the caller passes one to a seat.
        unsafe { seat.write(*last) };
        Ok(COROTATE_OK)
    })
}

/// Sends the outputs of the tick under way, if there is one, and waits for the next. Returns `COROTATE_TICK`, or `COROTATE_OK` at the end
/// of the run. Outputs that are not written are zero, except `valid`, whose bits are set.
#[allow(unsafe_code, reason = "a name that C can link")]
#[unsafe(no_mangle)]
pub extern "C" fn corotate_seat_wait(seat: corotate_seat) -> c_int {
    with(seat, |seat| Ok(if seat.wait()? { COROTATE_TICK } else { COROTATE_OK }))
}

/// Writes the tick under way to `tick`, and its time since tick 0 in seconds to `time_s`; either may be null.
///
/// # Safety
/// The pointers are null or point to objects of their types.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_tick(seat: corotate_seat, tick: *mut u64, time_s: *mut f64) -> c_int {
    with(seat, |seat| {
        let now = seat.tick()?;
        if !tick.is_null() {
            // SAFETY: the caller passes a pointer to an integer.
            unsafe { tick.write(now) };
        }
        if !time_s.is_null() {
            // SAFETY: the caller passes a pointer to a number.
            unsafe { time_s.write(now as f64 * seat.period_s()) };
        }
        Ok(COROTATE_OK)
    })
}

/// Writes the period in seconds to `period_s`, and the last tick to `last_tick`; either may be null.
///
/// # Safety
/// The pointers are null or point to objects of their types.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_grid(seat: corotate_seat, period_s: *mut f64, last_tick: *mut u64) -> c_int {
    with(seat, |seat| {
        if !period_s.is_null() {
            // SAFETY: the caller passes a pointer to a number.
            unsafe { period_s.write(seat.period_s()) };
        }
        if !last_tick.is_null() {
            // SAFETY: the caller passes a pointer to an integer.
            unsafe { last_tick.write(seat.last_tick()) };
        }
        Ok(COROTATE_OK)
    })
}

/// Copies an input of the tick under way, as `estimate` or `follower/measurement`, to `sample`, which has `size` bytes. Returns
/// `COROTATE_MISSING`, and leaves `sample` as it is, if the input has no sample.
///
/// # Safety
/// `signal` is null or a text that ends with NUL; `sample` is null or has room for `size` bytes.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_read(
    seat: corotate_seat,
    signal: *const c_char,
    sample: *mut c_void,
    size: usize,
) -> c_int {
    with(seat, |seat| {
        // SAFETY: the caller passes a text.
        let name = unsafe { text(signal)? };
        if sample.is_null() {
            return Err(SeatError::Null);
        }
        let Some(content) = seat.read(name, size)? else { return Ok(COROTATE_MISSING) };
        // SAFETY: the content has `size` bytes, and the caller passes room for them.
        unsafe { sample.cast::<u8>().copy_from(content.as_ptr(), size) };
        Ok(COROTATE_OK)
    })
}

/// Copies `sample`, which has `size` bytes, to an output of the tick under way, as `command` or `follower/command`.
///
/// # Safety
/// `signal` is null or a text that ends with NUL; `sample` is null or has `size` bytes.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_write(
    seat: corotate_seat,
    signal: *const c_char,
    sample: *const c_void,
    size: usize,
) -> c_int {
    with(seat, |seat| {
        // SAFETY: the caller passes a text.
        let name = unsafe { text(signal)? };
        if sample.is_null() {
            return Err(SeatError::Null);
        }
        let place = seat.write(name, size)?;
        // SAFETY: the place has `size` bytes, and the caller passes as many.
        unsafe { place.as_mut_ptr().copy_from(sample.cast(), size) };
        Ok(COROTATE_OK)
    })
}

/// Copies the present numbers of an input of the loop, such as a gain or a reference, to `values`, which has room for `count`.
///
/// # Safety
/// `key` is null or a text that ends with NUL; `values` is null or has room for `count` numbers.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_value(
    seat: corotate_seat,
    key: *const c_char,
    values: *mut f64,
    count: usize,
) -> c_int {
    with(seat, |seat| {
        // SAFETY: the caller passes a text.
        let key = unsafe { text(key)? };
        if values.is_null() {
            return Err(SeatError::Null);
        }
        let found = seat.value(key, count)?;
        // SAFETY: there are `count` numbers, and the caller passes room for them.
        unsafe { values.copy_from(found.as_ptr(), count) };
        Ok(COROTATE_OK)
    })
}

/// Ends the run at the tick under way with a reason. `corotate_seat_wait` then returns `COROTATE_RUN_FAILED`.
///
/// # Safety
/// `reason` is null or a text that ends with NUL.
#[allow(unsafe_code, reason = "C names memory by pointers")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn corotate_seat_fail(seat: corotate_seat, reason: *const c_char) -> c_int {
    with(seat, |seat| {
        // SAFETY: the caller passes a text.
        let reason = unsafe { text(reason)? };
        seat.fail(reason).map(|()| COROTATE_OK)
    })
}

/// Gives the seat up. During the ticks that ends the run.
#[allow(unsafe_code, reason = "a name that C can link")]
#[unsafe(no_mangle)]
pub extern "C" fn corotate_seat_close(seat: corotate_seat) -> c_int {
    guarded(|| {
        let mut seats = seats();
        let open = seats.as_mut().and_then(|(open, _)| open.get(&seat).cloned()).ok_or(SeatError::Closed)?;
        drop(lock(&open)?);
        let removed = seats.as_mut().and_then(|(open, _)| open.remove(&seat));
        // The child is waited for without the list.
        drop(seats);
        drop((open, removed));
        Ok(COROTATE_OK)
    })
}

fn seats() -> MutexGuard<'static, Option<Seats>> {
    SEATS.lock().unwrap_or_else(PoisonError::into_inner)
}

fn lock(seat: &Mutex<Seat>) -> Result<MutexGuard<'_, Seat>, SeatError> {
    match seat.try_lock() {
        Ok(seat) => Ok(seat),
        Err(TryLockError::Poisoned(seat)) => Ok(seat.into_inner()),
        Err(TryLockError::WouldBlock) => Err(SeatError::Busy),
    }
}

/// Calls a function with an open seat.
fn with(seat: corotate_seat, call: impl FnOnce(&mut Seat) -> Result<c_int, SeatError>) -> c_int {
    guarded(|| {
        let open = seats().as_ref().and_then(|(open, _)| open.get(&seat).cloned()).ok_or(SeatError::Closed)?;
        let mut seat = lock(&open)?;
        call(&mut seat)
    })
}

/// Calls a function, keeps the sentence of its error, and returns its number.
fn guarded(call: impl FnOnce() -> Result<c_int, SeatError>) -> c_int {
    let called = catch_unwind(AssertUnwindSafe(call)).unwrap_or_else(|panic| {
        let words = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        Err(SeatError::Panic(words.unwrap_or("it panicked").to_owned()))
    });
    called.unwrap_or_else(|error| {
        let sentence = CString::new(error.to_string().replace('\0', " ")).unwrap_or_default();
        let _ = LAST_ERROR.try_with(|last| last.try_borrow_mut().map(|mut last| *last = sentence));
        error.number()
    })
}

/// Returns the bytes of a text in C.
///
/// # Safety
/// The pointer is null or points to a text that ends with NUL.
#[allow(unsafe_code, reason = "C names memory by pointers")]
unsafe fn bytes<'a>(text: *const c_char) -> Result<&'a [u8], SeatError> {
    if text.is_null() {
        return Err(SeatError::Null);
    }
    // SAFETY: the caller promises a text.
    Ok(unsafe { CStr::from_ptr(text) }.to_bytes())
}

/// Returns a text in C.
///
/// # Safety
/// As [`bytes`].
#[allow(unsafe_code, reason = "C names memory by pointers")]
unsafe fn text<'a>(text: *const c_char) -> Result<&'a str, SeatError> {
    // SAFETY: the caller promises a text.
    std::str::from_utf8(unsafe { bytes(text)? }).map_err(|_| SeatError::Text)
}

#[cfg(test)]
mod tests {
    /// The header in `include` is the one that cbindgen makes of this file. `COROTATE_WRITE_HEADER=1` writes it.
    #[test]
    fn the_header_is_that_of_this_file() {
        let root = env!("CARGO_MANIFEST_DIR");
        let config = cbindgen::Config::from_file(format!("{root}/cbindgen.toml")).unwrap();
        let bindings =
            cbindgen::Builder::new().with_src(format!("{root}/src/lib.rs")).with_config(config).generate().unwrap();
        let mut made = Vec::new();
        bindings.write(&mut made);
        let path = format!("{root}/include/corotate.h");
        if std::env::var_os("COROTATE_WRITE_HEADER").is_some() {
            std::fs::write(&path, &made).unwrap();
        }
        assert_eq!(std::fs::read_to_string(path).unwrap(), String::from_utf8(made).unwrap());
    }
}
