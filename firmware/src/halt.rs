//! The reaction to a panic: the device stops, and the host detects its silence.

/// Stops for ever.
pub fn halt() -> ! {
    loop {
        cortex_m::asm::nop();
    }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    halt()
}
