/* The follower of config/rigid-pair.toml as a device: written from docs/serial-protocol.md, without the library.
 *
 * For a Cortex-M7 (or M4F) of QEMU's mps2 boards, without an operating system and without an allocator. Another board needs
 * other code between the lines "board" and "end of board" only. Every received byte must be checked. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* ---- board: a CMSDK UART, and SysTick for the time ------------------------------------------------------------------- */

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART_DATA REGISTER(0x40004000)
#define UART_STATE REGISTER(0x40004004) /* bit 0: transmitter full; bit 1: byte received */
#define UART_CONTROL REGISTER(0x40004008)
#define UART_INTERRUPTS REGISTER(0x4000400c)
#define UART_DIVISOR REGISTER(0x40004010)
#define INTERRUPTS_ON REGISTER(0xe000e100)
#define SYSTICK_CONTROL REGISTER(0xe000e010)
#define SYSTICK_RELOAD REGISTER(0xe000e014)
#define SYSTICK_CURRENT REGISTER(0xe000e018)
#define COPROCESSORS REGISTER(0xe000ed88)
enum { CLOCK_HZ = 25000000, BAUD = 1000000 };

static volatile uint32_t milliseconds;

static void on_systick(void) { milliseconds++; }
static void on_byte(void) { UART_INTERRUPTS = 3; }
static void board_start(void) {
    UART_DIVISOR = CLOCK_HZ / BAUD;
    UART_CONTROL = 11, INTERRUPTS_ON = 1; /* send, receive, interrupt 0 on a received byte */
    SYSTICK_RELOAD = CLOCK_HZ / 1000 - 1;
    SYSTICK_CURRENT = 0;
    SYSTICK_CONTROL = 7;
}

static bool board_read(uint8_t *byte) {
    bool received = UART_STATE & 2;
    if (received) *byte = (uint8_t)UART_DATA;
    return received;
}

static void board_write(const uint8_t *bytes, size_t count) {
    for (size_t i = 0; i < count; i++) {
        while (UART_STATE & 1) {}
        UART_DATA = bytes[i];
    }
}

/* Sleeps until a byte is received or a millisecond has passed. A byte received between the check and the sleep ends the
 * sleep. */
static void board_wait(void) {
    __asm__ volatile("cpsid i");
    if (!(UART_STATE & 2)) __asm__ volatile("wfi");
    __asm__ volatile("cpsie i");
}

static uint64_t board_ns(void) { return milliseconds * UINT64_C(1000000); }

/* ---- end of board; the protocol -------------------------------------------------------------------------------------- */

enum { VERSION = 2, MAX_PAYLOAD = 1020, CRC_BYTES = 4, MAX_CHECKED = MAX_PAYLOAD + CRC_BYTES, MAX_BLOCK = 1029 };
enum kind { HELLO, WELCOME, REFUSE, TICK, ANSWER, STOP };
enum reason { OTHER_VERSION, OTHER_SAMPLES, OTHER_ROLE, NOT_GREETED };
enum event { NOT_DUE, APPLIED, REFUSED, HELD, EXPIRED, SAFE };

static const char NAME[] = "follower in C 1";
static const char ROLE[] = "follower";
static const char READS[] = "corotate/rigid-body/command/v2#ff8ce508";
static const char MEASUREMENT[] = "corotate/rigid-body/measurement/v1#bcfd8b41";
static const char TRUTH[] = "corotate/rigid-body/truth/v1#6b083b5d";
static const char WRITES[] = "corotate/rigid-body/measurement/v1#bcfd8b41 corotate/rigid-body/truth/v1#6b083b5d";
enum { COMMAND_BYTES = 5 * 8, MEASUREMENT_BYTES = 8 * 8, TRUTH_BYTES = 7 * 8 };

static uint32_t crc32(const uint8_t *bytes, size_t count) {
    uint32_t crc = 0xffffffff;
    for (size_t i = 0; i < count; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320 : 0);
    }
    return ~crc;
}

/* The position in a payload. After a missing field all further fields are missing. */
struct reader {
    const uint8_t *at, *end;
    bool ok;
};

static uint64_t read_varint(struct reader *from, unsigned bits) {
    uint64_t value = 0;
    for (unsigned shift = 0; from->ok && shift < bits; shift += 7) {
        if (from->at == from->end) break;
        uint8_t byte = *from->at++;
        uint64_t part = byte & 0x7f;
        if (shift + 7 > bits && part >> (bits - shift)) break;
        value |= part << shift;
        if (!(byte & 0x80)) return value;
    }
    from->ok = false;
    return 0;
}

static bool read_bool(struct reader *from) { return read_varint(from, 1) == 1; }

/* Reads a text or bytes: returns the length and sets `*at` to the first byte. */
static size_t read_bytes(struct reader *from, const uint8_t **at) {
    uint64_t length = read_varint(from, 32);
    *at = from->at;
    if (!from->ok || length > (uint64_t)(from->end - from->at)) {
        from->ok = false;
        return 0;
    }
    from->at += length;
    return (size_t)length;
}

static uint8_t payload[MAX_PAYLOAD + CRC_BYTES];
static size_t payload_length;

static void put_byte(uint8_t byte) { payload[payload_length++] = byte; }

static void put_varint(uint64_t value) {
    for (; value > 0x7f; value >>= 7) put_byte((uint8_t)(value | 0x80));
    put_byte((uint8_t)value);
}

static void put_bytes(const void *bytes, size_t count) {
    memcpy(payload + payload_length, bytes, count);
    payload_length += count;
}

static void put_text(const char *text) { put_varint(strlen(text)), put_bytes(text, strlen(text)); }

static void begin(enum kind kind) {
    static uint32_t sequence;
    payload_length = 0;
    put_byte(VERSION);
    put_varint(sequence++);
    put_byte(kind);
}

static void send(void) {
    static uint8_t frame[MAX_BLOCK + 2];
    uint32_t crc = crc32(payload, payload_length);
    put_bytes(&crc, CRC_BYTES);
    size_t length = 2, code = 1;
    frame[0] = 0, frame[code] = 1;
    for (size_t i = 0; i < payload_length; i++) {
        if (payload[i] != 0) {
            frame[length++] = payload[i];
            frame[code]++;
        }
        if (payload[i] == 0 || (frame[code] == 0xff && i + 1 < payload_length)) {
            code = length;
            frame[length++] = 1;
        }
    }
    frame[length++] = 0;
    board_write(frame, length);
}

static void refuse(enum reason reason, const char *detail) {
    begin(REFUSE);
    put_byte(reason);
    put_text(detail);
    send();
}

/* ---- the body -------------------------------------------------------------------------------------------------------- */

static const double INERTIA[3] = {1.0, 2.0, 2.5};
static const double INITIAL_RATE[3] = {-0.3, 0.5, 0.2};

static struct {
    double rate[3], applied[3], step_s;
    bool safe;
    uint64_t missing, timeout;
} body;

/* Computes Euler's equations with the held acceleration. */
static void slope(const double w[3], double out[3]) {
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        out[i] = (INERTIA[j] - INERTIA[k]) / INERTIA[i] * w[j] * w[k] + body.applied[i];
    }
}

/* Moves the body over one period by the classical Runge-Kutta method, in two steps: the error is below rounding at 1 kHz. */
static void move(void) {
    enum { STEPS = 2 };
    const double h = body.step_s / STEPS;
    for (int step = 0; step < STEPS; step++) {
        double k[4][3], at[3];
        const double reach[4] = {0.0, h / 2.0, h / 2.0, h};
        for (int stage = 0; stage < 4; stage++) {
            for (int i = 0; i < 3; i++) at[i] = body.rate[i] + (stage ? reach[stage] * k[stage - 1][i] : 0.0);
            slope(at, k[stage]);
        }
        for (int i = 0; i < 3; i++) body.rate[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
}

static void go_safe(void) {
    memset(body.applied, 0, sizeof body.applied), body.safe = true;
}

static enum event missing_command(void) {
    body.missing++;
    if (body.safe || body.missing < body.timeout) return body.safe ? SAFE : HELD;
    go_safe();
    return EXPIRED;
}

static uint64_t ticks_until_safe(void) {
    return body.safe ? 0 : body.timeout > body.missing + 1 ? body.timeout - body.missing : 1;
}

/* ---- the run --------------------------------------------------------------------------------------------------------- */

static struct {
    bool known, realtime, manual_rearm, begun;
    uint64_t number, period_ns, last_tick;
    uint64_t next, executed_ns;           /* valid once begun */
    bool answered;                        /* true if the answer of the last executed tick can be repeated */
    uint64_t tick;
    enum event event;
    uint8_t outputs[MEASUREMENT_BYTES + TRUTH_BYTES];
} run;

static void catch_up(uint64_t ticks) {
    enum { MOST = 100000 }; /* after a longer absence the body's clock jumps */
    for (uint64_t i = 0; i < ticks && i < MOST; i++) {
        missing_command();
        move();
    }
}

static void on_hello(struct reader *from) {
    uint64_t number = read_varint(from, 64);
    bool realtime = read_bool(from);
    uint64_t period_ns = read_varint(from, 64), last_tick = read_varint(from, 64), timeout = read_varint(from, 64);
    bool manual_rearm = read_bool(from);
    const uint8_t *role, *reads, *writes;
    size_t role_length = read_bytes(from, &role), reads_length = read_bytes(from, &reads);
    size_t writes_length = read_bytes(from, &writes);
    if (!from->ok || from->at != from->end) return;
    if (reads_length != strlen(READS) || memcmp(reads, READS, reads_length)) return refuse(OTHER_SAMPLES, READS);
    if (writes_length != strlen(WRITES) || memcmp(writes, WRITES, writes_length)) {
        bool first = writes_length >= strlen(MEASUREMENT) && !memcmp(writes, MEASUREMENT, strlen(MEASUREMENT));
        return refuse(OTHER_SAMPLES, first ? TRUTH : MEASUREMENT);
    }
    if (role_length != strlen(ROLE) || memcmp(role, ROLE, role_length) || !period_ns || !timeout) {
        return refuse(OTHER_ROLE, "this device is the follower");
    }
    if (!run.known || run.number != number) {
        memset(&run, 0, sizeof run);
        memset(&body, 0, sizeof body);
        memcpy(body.rate, INITIAL_RATE, sizeof body.rate);
        body.step_s = (double)period_ns / 1e9;
        body.timeout = timeout;
        run.known = true, run.number = number;
        run.realtime = realtime, run.manual_rearm = manual_rearm, run.period_ns = period_ns;
        run.last_tick = last_tick < UINT64_MAX ? last_tick : last_tick - 1;
    }
    begin(WELCOME);
    put_varint(number);
    put_varint(run.begun ? run.next : 0);
    put_text(NAME);
    send();
}

static enum event take_command(uint64_t tick, const uint8_t *content) {
    if (tick == 0) return NOT_DUE;
    if (content == NULL) return missing_command();
    if (body.safe && run.manual_rearm) return REFUSED;
    double acceleration[3];
    memcpy(acceleration, content, sizeof acceleration);
    for (int i = 0; i < 3; i++) {
        if (!isfinite(acceleration[i])) return missing_command();
    }
    memcpy(body.applied, acceleration, sizeof acceleration);
    body.missing = 0, body.safe = false;
    return APPLIED;
}

static void measure(void) {
    uint64_t valid = 7, status = body.safe ? 2 : body.missing ? 1 : 0;
    uint8_t *to = run.outputs, *truth = run.outputs + MEASUREMENT_BYTES;
    memcpy(to, body.rate, 24);
    memcpy(to + 24, body.applied, 24);
    memcpy(to + 48, &valid, 8);
    memcpy(to + 56, &status, 8);
    memcpy(truth, to, 48);
    memcpy(truth + 48, &status, 8);
}

static void answer(uint32_t echo) {
    begin(ANSWER);
    put_varint(echo);
    put_varint(run.tick);
    put_byte((uint8_t)run.event);
    put_varint(3); /* both samples are present */
    put_varint(sizeof run.outputs);
    put_bytes(run.outputs, sizeof run.outputs);
    send();
}

static void on_tick(struct reader *from, uint32_t sequence) {
    const uint8_t *bytes;
    uint64_t tick = read_varint(from, 64);
    uint32_t present = (uint32_t)read_varint(from, 32);
    size_t length = read_bytes(from, &bytes);
    if (!from->ok || from->at != from->end) return;
    if (!run.known) return refuse(NOT_GREETED, "greet me first");
    if (run.answered && tick == run.tick) return answer(sequence);
    uint64_t next = run.begun ? run.next : tick;
    if (tick < next || tick > run.last_tick || present > 1 || length != present * COMMAND_BYTES) return;
    catch_up(tick - next);
    run.event = take_command(tick, present ? bytes : NULL);
    measure();
    run.tick = tick, run.next = tick + 1;
    run.begun = run.answered = true;
    run.executed_ns = board_ns();
    answer(sequence);
    move();
}

/* Applies the safe command by the device's own clock if no ticks arrive. */
static void elapse(void) {
    uint64_t left = ticks_until_safe();
    if (!run.known || !run.begun || !run.realtime || !left) return;
    if (board_ns() - run.executed_ns < left * run.period_ns + run.period_ns / 2) return;
    catch_up(left);
    run.next += left;
}

static void on_payload(const uint8_t *bytes, size_t length) {
    struct reader from = {bytes, bytes + length, length > 0};
    if (!from.ok) return;
    if (*from.at++ != VERSION) return refuse(OTHER_VERSION, "another version of the protocol");
    uint32_t sequence = (uint32_t)read_varint(&from, 32);
    uint64_t kind = read_varint(&from, 32);
    if (!from.ok) return;
    if (kind == HELLO) on_hello(&from);
    if (kind == TICK) on_tick(&from, sequence);
    if (kind == STOP && from.at == from.end && run.known) go_safe();
}

/* Decodes a block in place and handles its payload if the CRC is valid. */
static void on_block(uint8_t *block, size_t length) {
    size_t from = 0, to = 0;
    while (from < length) {
        uint8_t code = block[from++];
        if ((size_t)(code - 1) > length - from) return;
        for (uint8_t i = 1; i < code; i++) block[to++] = block[from++];
        if (code != 0xff && from < length) block[to++] = 0;
    }
    uint32_t crc;
    if (to < CRC_BYTES || to > MAX_CHECKED) return;
    memcpy(&crc, block + to - CRC_BYTES, CRC_BYTES);
    if (crc == crc32(block, to - CRC_BYTES)) on_payload(block, to - CRC_BYTES);
}

int main(void) {
    static uint8_t block[MAX_BLOCK];
    size_t length = 0;
    bool too_long = false;
    board_start();
    for (;;) {
        uint8_t byte;
        board_wait(), elapse();
        if (!board_read(&byte)) continue;
        if (byte != 0) {
            if (length < MAX_BLOCK) block[length++] = byte;
            else too_long = true;
            continue;
        }
        if (length && !too_long) on_block(block, length);
        length = 0, too_long = false;
    }
}

/* ---- start: the vectors, and the memory for C ------------------------------------------------------------------------ */

extern uint32_t stack_top, bss_begin, bss_end;

void on_reset(void);
void on_reset(void) {
    COPROCESSORS |= 0xf << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    memset(&bss_begin, 0, (size_t)((uint8_t *)&bss_end - (uint8_t *)&bss_begin));
    main();
}

static void on_fault(void) { for (;;) {} }

__attribute__((section(".vectors"), used)) static void *const VECTORS[17] = {
    &stack_top, on_reset, on_fault, on_fault, on_fault, on_fault, on_fault, 0, 0, 0, 0, on_fault, on_fault, 0, on_fault, on_systick, on_byte,
};
