//! A device without an operating system: bytes in, frames out, and a look at the clock, for ever.
//!
//! The flight computer of `config/rigid-pair.toml`, or with the feature `follower` its follower. Allocates nothing.

#![no_std]
#![no_main]

use corotate::serial::Device;
use corotate_firmware::board::Board;
#[cfg(not(feature = "follower"))]
use corotate_firmware::flight as role;
#[cfg(feature = "follower")]
use corotate_firmware::follower as role;
use corotate_firmware::halt::halt;
use cortex_m_rt::entry;

#[entry]
fn main() -> ! {
    // Taken once, here: it is there.
    let Some(core) = cortex_m::Peripherals::take() else { halt() };
    let mut board = Board::start(core);
    let mut device = Device::new(role::NAME, role::seat);
    loop {
        board.wait();
        let now_ns = board.now_ns();
        while let Some(byte) = board.read() {
            device.receive(&[byte], now_ns, |frame| board.write(frame));
        }
        device.elapse(now_ns);
    }
}
