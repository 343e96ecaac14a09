//! The boards `mps2-an386` (Cortex-M4F) and `mps2-an500` (Cortex-M7) of QEMU. Another board needs other code here and
//! another `memory.x`.
//!
//! A board provides three functions: bytes on a line, a time that advances without bytes, and a wait for either.

use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::{Peripherals, asm, interrupt};
use cortex_m_rt::exception;

/// UART0, a CMSDK UART: data, state (bit 0: full, bit 1: byte received), control (bits 0 and 1: send, receive; bit 3:
/// interrupt on a received byte), interrupts (cleared by ones), divisor.
const UART0: *mut u32 = 0x4000_4000 as *mut u32;
const DATA: usize = 0;
const STATE: usize = 1;
const CONTROL: usize = 2;
const INTERRUPTS: usize = 3;
const DIVISOR: usize = 4;
/// The number of the receive interrupt.
const RECEIVED: u32 = 0;
const CLOCK_HZ: u32 = 25_000_000;
const BAUD: u32 = 1_000_000;

static MILLISECONDS: AtomicU32 = AtomicU32::new(0);

#[exception]
fn SysTick() {
    MILLISECONDS.fetch_add(1, Ordering::Relaxed);
}

/// Acknowledges a received byte; the interrupt ends the wait.
#[exception]
unsafe fn DefaultHandler(_: i16) {
    write(INTERRUPTS, 0b11);
}

/// The board in use.
pub struct Board;

impl Board {
    /// Starts the line and the time.
    pub fn start(mut core: Peripherals) -> Self {
        write(DIVISOR, CLOCK_HZ / BAUD);
        write(CONTROL, 0b1011);
        // SAFETY: the handler of this interrupt is above and shares no data.
        unsafe { core.NVIC.iser[0].write(1 << RECEIVED) };
        core.SYST.set_clock_source(SystClkSource::Core);
        core.SYST.set_reload(CLOCK_HZ / 1000 - 1);
        core.SYST.clear_current();
        core.SYST.enable_counter();
        core.SYST.enable_interrupt();
        Self
    }

    /// Returns the next byte of the line, if one has been received.
    pub fn read(&mut self) -> Option<u8> {
        (read(STATE) & 0b10 != 0).then(|| read(DATA) as u8)
    }

    /// Waits for a byte or for the next millisecond.
    pub fn wait(&mut self) {
        // A byte received between the check and the sleep ends the sleep.
        interrupt::disable();
        if read(STATE) & 0b10 == 0 {
            asm::wfi();
        }
        // SAFETY: interrupts were enabled before.
        unsafe { interrupt::enable() };
    }

    /// Sends bytes and blocks until the last one is accepted.
    pub fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            while read(STATE) & 0b01 != 0 {}
            write(DATA, u32::from(*byte));
        }
    }

    /// Returns the time since the start, ns; it wraps after 49 days.
    pub fn now_ns(&self) -> u64 {
        u64::from(MILLISECONDS.load(Ordering::Relaxed)) * 1_000_000
    }
}

fn read(register: usize) -> u32 {
    // SAFETY: a register of this board's UART, which no other code accesses.
    unsafe { UART0.add(register).read_volatile() }
}

fn write(register: usize, value: u32) {
    // SAFETY: as in `read`.
    unsafe { UART0.add(register).write_volatile(value) }
}
