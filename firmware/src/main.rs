//! A device without an operating system: receives bytes, sends frames and checks the clock, for ever.
//!
//! The flight computer of `config/rigid-pair.toml`, or its follower with the feature `follower`. Does not allocate.

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
    // Succeeds: this is the only call.
    let Some(core) = cortex_m::Peripherals::take() else { halt() };
    let mut board = Board::start(core);
    let mut device = Device::new(role::NAME, role::make_role);
    loop {
        board.wait();
        let now_ns = board.now_ns();
        while let Some(byte) = board.read() {
            device.receive(&[byte], now_ns, |frame| board.write(frame));
        }
        device.elapse(now_ns);
    }
}
