/* The follower of config/rigid-pair.toml as a device that sets the pace: each cycle of its own timer executes one tick.
 *
 *     paced udp 7700 | pty 0  [PPM [JITTER_US]]
 *
 * PPM is the error of the timer, JITTER_US the longest delay of a frame. SIGUSR1 cuts the line, and again restores it.
 * Written from docs/serial-protocol.md, without the library, for Linux. On your hardware, replace the part "machine" and `main` by a
 * timer and a line, `move` and `measure` by actuators and gyros. Every received byte must be checked. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <math.h>
#include <netinet/in.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>
/* ---- machine: a clock, and a line that may be cut ----------------------------------------------------------------------- */
enum { MAX_FRAME = 1031, SPIN_NS = 100000 };
static int line = -1, is_udp;
static struct sockaddr_in6 host;
static volatile sig_atomic_t is_cut, ended;
static void on_signal(int number) { number == SIGUSR1 ? (is_cut = !is_cut) : (ended = 1); }
static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}
static void line_send(const uint8_t *frame, size_t length) {
    ssize_t sent = is_cut ? 0 : is_udp ? sendto(line, frame, length, 0, (struct sockaddr *)&host, sizeof host) : write(line, frame, length);
    (void)sent; /* bytes that the line refuses are lost */
}
static size_t line_read(uint8_t *bytes, size_t length) {
    socklen_t size = sizeof host;
    ssize_t count = is_udp ? recvfrom(line, bytes, length, 0, (struct sockaddr *)&host, &size) : read(line, bytes, length);
    return count > 0 && !is_cut ? (size_t)count : 0;
}

/* ---- the protocol: frames ------------------------------------------------------------------------------------------------ */
enum { VERSION = 2, MAX_PAYLOAD = 1020, CRC_BYTES = 4 };
enum kind { HELLO, WELCOME, REFUSE, TICK, ANSWER, STOP };
enum reason { OTHER_VERSION, OTHER_SAMPLES, OTHER_ROLE, NOT_GREETED };
enum event { NOT_DUE, APPLIED, REFUSED, HELD, EXPIRED, SAFE };
static const char NAME[] = "paced in C 1", ROLE[] = "follower", READS[] = "corotate/rigid-body/command/v2#ff8ce508";
static const char WRITES[] = "corotate/rigid-body/measurement/v1#bcfd8b41 corotate/rigid-body/truth/v1#6b083b5d";

static uint32_t crc32(const uint8_t *bytes, size_t count) {
    uint32_t crc = 0xffffffff;
    while (count--) {
        crc ^= *bytes++;
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320 : 0);
    }
    return ~crc;
}

struct reader { const uint8_t *at, *end; bool ok; };

/* After a missing field all further fields are missing. */
static uint64_t read_varint(struct reader *from) {
    uint64_t value = 0;
    for (unsigned shift = 0; from->ok && shift < 64 && from->at < from->end; shift += 7) {
        value |= (uint64_t)(*from->at & 0x7f) << shift;
        if (!(*from->at++ & 0x80)) return value;
    }
    return from->ok = false;
}
static size_t read_bytes(struct reader *from, const uint8_t **at) {
    uint64_t length = read_varint(from);
    *at = from->at;
    from->ok = from->ok && length <= (uint64_t)(from->end - from->at);
    from->at += from->ok ? length : 0;
    return from->ok ? (size_t)length : 0;
}
static bool read_text(struct reader *from, const char *text) {
    const uint8_t *at;
    return read_bytes(from, &at) == strlen(text) && !memcmp(at, text, strlen(text));
}

static uint8_t payload[MAX_PAYLOAD + CRC_BYTES], frame[MAX_FRAME];
static size_t payload_length, frame_length; /* a frame that waits to be sent has a length */
static uint32_t sequence;                   /* of frames, and of cycles before the first tick */
static void put_byte(uint8_t byte) { payload[payload_length++] = byte; }
static void put_bytes(const void *bytes, size_t count) { memcpy(payload + payload_length, bytes, count), payload_length += count; }
static void put_text(const char *text) { put_byte((uint8_t)strlen(text)), put_bytes(text, strlen(text)); }
static void put_varint(uint64_t value) {
    for (; value > 0x7f; value >>= 7) put_byte((uint8_t)(value | 0x80));
    put_byte((uint8_t)value);
}

static void begin(enum kind kind) {
    payload_length = 0, put_byte(VERSION), put_varint(sequence++), put_byte(kind);
}
static void send_frame(void) { line_send(frame, frame_length), frame_length = 0; }
static void end_frame(void) {
    uint32_t crc = crc32(payload, payload_length);
    size_t code = 1;
    if (frame_length) send_frame();
    put_bytes(&crc, CRC_BYTES);
    frame[0] = 0, frame[code] = 1, frame_length = 2;
    for (size_t i = 0; i < payload_length; i++) {
        if (payload[i]) frame[frame_length++] = payload[i], frame[code]++;
        if (!payload[i] || (frame[code] == 0xff && i + 1 < payload_length)) code = frame_length++, frame[code] = 1;
    }
    frame[frame_length++] = 0;
}

static void refuse(enum reason reason, const char *why) { begin(REFUSE), put_byte(reason), put_text(why), end_frame(), send_frame(); }

/* ---- the body ------------------------------------------------------------------------------------------------------------ */
static const double INERTIA[3] = {1.0, 2.0, 2.5}, INITIAL_RATE[3] = {-0.3, 0.5, 0.2};
static struct { double rate[3], applied[3], step_s; bool safe; uint64_t missing, timeout; } body;

/* Moves the body over one period by the classical Runge-Kutta method. */
static void move(void) {
    double h = body.step_s, reach[4] = {0.0, h / 2.0, h / 2.0, h}, k[5][3] = {{0.0}}, at[3];
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < 3; i++) at[i] = body.rate[i] + reach[stage] * k[stage][i];
        for (int i = 0; i < 3; i++) {
            int j = (i + 1) % 3, l = (i + 2) % 3;
            k[stage + 1][i] = (INERTIA[j] - INERTIA[l]) / INERTIA[i] * at[j] * at[l] + body.applied[i];
        }
    }
    for (int i = 0; i < 3; i++) body.rate[i] += h / 6.0 * (k[1][i] + 2.0 * k[2][i] + 2.0 * k[3][i] + k[4][i]);
}

static void go_safe(void) { memset(body.applied, 0, sizeof body.applied), body.safe = true; }
static enum event missing_command(void) {
    if (++body.missing < body.timeout || body.safe) return body.safe ? SAFE : HELD;
    return go_safe(), EXPIRED;
}

/* ---- the run --------------------------------------------------------------------------------------------------------------- */
static struct {
    bool known, begun, greeted, stopped, manual_rearm, is_late;
    uint64_t number, period_ns, last_tick, tick, next;
    unsigned long long cycles, slips, overslept, late, ahead;
    enum event event;
    uint32_t echo;
    uint8_t outputs[64 + 56];
} run;
/* The requests of the next ticks, by tick modulo 2. */
static struct request { bool waits, present; uint32_t sequence; uint64_t tick; double command[3]; } requests[2];

static void on_hello(struct reader *from) {
    uint64_t number = read_varint(from), realtime = read_varint(from), period_ns = read_varint(from);
    uint64_t last_tick = read_varint(from), timeout = read_varint(from), manual_rearm = read_varint(from);
    bool role = read_text(from, ROLE), reads = read_text(from, READS), writes = read_text(from, WRITES);
    if (from->at != from->end) return;
    if (!reads || !writes) return refuse(OTHER_SAMPLES, READS);
    if (!role || !realtime || !period_ns || !timeout) return refuse(OTHER_ROLE, "this device is the follower, in real time");
    if (!run.known || run.number != number) {
        memset(&run, 0, sizeof run), memset(&body, 0, sizeof body), memset(requests, 0, sizeof requests);
        memcpy(body.rate, INITIAL_RATE, sizeof body.rate);
        body.step_s = (double)period_ns / 1e9, body.timeout = timeout;
        run.known = true, run.number = number, run.period_ns = period_ns, run.manual_rearm = manual_rearm;
        run.last_tick = last_tick < UINT64_MAX ? last_tick : last_tick - 1;
    }
    run.greeted = true; /* Welcome follows at the next cycle */
}

static void welcome(void) {
    begin(WELCOME), put_varint(run.number), put_varint(run.begun ? run.next : 0), put_text(NAME), end_frame(), run.greeted = false;
}
static void answer(void) {
    begin(ANSWER), put_varint(run.echo), put_varint(run.tick), put_byte((uint8_t)run.event), put_varint(3);
    put_varint(sizeof run.outputs), put_bytes(run.outputs, sizeof run.outputs), end_frame();
}

static void on_tick(struct reader *from, uint32_t sequence) {
    const uint8_t *bytes;
    uint64_t tick = read_varint(from), present = read_varint(from);
    size_t length = read_bytes(from, &bytes);
    if (!from->ok || from->at != from->end || present > 1 || length != present * 40) return;
    if (!run.known || tick > run.last_tick) return run.known ? (void)0 : refuse(NOT_GREETED, "greet me first");
    run.stopped = false;
    if (!run.begun || tick >= run.next) {
        requests[tick % 2] = (struct request){.waits = true, .present = present, .sequence = sequence, .tick = tick};
        if (present) memcpy(requests[tick % 2].command, bytes, sizeof requests->command);
        run.is_late = false;
    } else if (tick == run.tick) {
        run.echo = sequence, answer(), send_frame(), run.is_late = true; /* the cycle of this tick has passed */
    }
}

static bool is_asked(uint64_t tick) { return requests[tick % 2].waits && requests[tick % 2].tick == tick; }
static bool is_later(int i) { return requests[i].waits && requests[i].tick > run.next; }

static enum event take_command(const struct request *request) {
    if (run.next == 0) return NOT_DUE;
    bool usable = is_asked(run.next) && request->present;
    for (int i = 0; i < 3; i++) usable = usable && isfinite(request->command[i]);
    if (!usable || (body.safe && run.manual_rearm)) return usable ? REFUSED : missing_command();
    memcpy(body.applied, request->command, sizeof body.applied), body.missing = 0, body.safe = false;
    return APPLIED;
}

static void measure(void) {
    uint64_t valid = 7, status = body.safe ? 2 : body.missing ? 1 : 0;
    uint8_t *truth = run.outputs + 64;
    memcpy(run.outputs, body.rate, 24), memcpy(run.outputs + 24, body.applied, 24), memcpy(truth, run.outputs, 48);
    memcpy(run.outputs + 48, &valid, 8), memcpy(run.outputs + 56, &status, 8), memcpy(truth + 48, &status, 8);
}

/* Executes the next tick, and makes the frame of this cycle: until the first tick Welcome, then the answer. */
static void cycle(void) {
    bool begins = !run.begun && (requests[0].waits || requests[1].waits);
    if (!run.known || run.stopped || (run.begun && run.next > run.last_tick)) return;
    if (run.greeted || (!run.begun && !begins)) welcome();
    if (!run.begun && !begins) return;
    /* Of two requests before the first cycle, the later one is for this cycle. */
    if (begins) run.next = requests[!requests[0].waits || is_later(1)].tick, run.begun = true;
    run.cycles++;
    /* A host that does not follow drifts away: four late requests in a row pass over a cycle, four early ones a tick. */
    run.late = run.is_late ? run.late + 1 : 0, run.is_late = false;
    run.ahead = !is_asked(run.next) && (is_later(0) || is_later(1)) ? run.ahead + 1 : 0;
    if (run.late == 4) return run.late = 0, move();
    run.slips += !is_asked(run.next) && !is_cut;
    if (run.ahead == 4) run.ahead = 0, run.next++, missing_command(), move();
    run.event = take_command(&requests[run.next % 2]);
    if (is_asked(run.next)) run.echo = requests[run.next % 2].sequence, requests[run.next % 2].waits = false;
    run.tick = run.next++, measure(), answer(), move();
}

/* Decodes a block in place and handles its message if the CRC is valid. */
static void on_block(uint8_t *block, size_t length) {
    size_t from = 0, to = 0;
    while (from < length) {
        uint8_t code = block[from++];
        if ((size_t)(code - 1) > length - from) return;
        for (uint8_t i = 1; i < code; i++) block[to++] = block[from++];
        if (code != 0xff && from < length) block[to++] = 0;
    }
    if (to <= CRC_BYTES || to > sizeof payload) return;
    if (memcmp(block + to - CRC_BYTES, &(uint32_t){crc32(block, to - CRC_BYTES)}, CRC_BYTES)) return;
    if (block[0] != VERSION) return refuse(OTHER_VERSION, "another version of the protocol");
    struct reader reader = {block + 1, block + to - CRC_BYTES, true};
    uint64_t sequence = read_varint(&reader), kind = read_varint(&reader);
    if (kind == HELLO) on_hello(&reader);
    if (kind == TICK) on_tick(&reader, (uint32_t)sequence);
    if (kind == STOP && reader.ok && reader.at == reader.end) go_safe(), run.stopped = true;
}

static void receive(void) {
    static uint8_t block[MAX_FRAME], bytes[MAX_FRAME + 1];
    static size_t length;
    for (size_t count = line_read(bytes, sizeof bytes), i = 0; i < count; i++) {
        if (bytes[i] && length < MAX_FRAME) block[length++] = bytes[i];
        if (!bytes[i] && length && length < MAX_FRAME) on_block(block, length);
        if (!bytes[i]) length = 0;
    }
}

/* Sleeps until a frame comes, or shortly before `due_ns`, and spins for the rest. */
static void wait_until(int64_t due_ns) {
    struct pollfd ready = {line, POLLIN, 0};
    int64_t left_ns = due_ns - now_ns() - SPIN_NS;
    struct timespec timeout = {left_ns / 1000000000, left_ns % 1000000000};
    if (left_ns > 0 && ppoll(&ready, 1, &timeout, NULL) == 0) left_ns = 0;
    while (left_ns <= 0 && now_ns() < due_ns) {}
}

int main(int count, char **options) {
    if (count < 3) return fprintf(stderr, "usage: paced udp PORT | pty 0  [PPM [JITTER_US]]\n"), 2;
    double rate = 1.0 + (count > 3 ? atof(options[3]) : 0.0) * 1e-6, jitter_ns = count > 4 ? atof(options[4]) * 1e3 : 0.0;
    is_udp = !strcmp(options[1], "udp");
    if (is_udp) {
        struct sockaddr_in6 own = {.sin6_family = AF_INET6, .sin6_port = htons((uint16_t)atoi(options[2])), .sin6_addr = in6addr_any};
        line = socket(AF_INET6, SOCK_DGRAM | SOCK_NONBLOCK, 0); /* takes IPv4 too */
        if (bind(line, (struct sockaddr *)&own, sizeof own)) return perror("paced: cannot bind the port"), 1;
    } else {
        struct termios raw;
        line = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
        if (line < 0 || grantpt(line) || unlockpt(line)) return perror("paced: cannot open a pty"), 1;
        tcgetattr(open(ptsname(line), O_RDWR | O_NOCTTY), &raw), cfmakeraw(&raw), tcsetattr(line, TCSANOW, &raw);
    }
    printf("%s\n", is_udp ? options[2] : ptsname(line)), fflush(stdout);
    signal(SIGUSR1, on_signal), signal(SIGTERM, on_signal), signal(SIGINT, on_signal);
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = 85}); /* refused: cycles begin late at times */
    int64_t base_ns = now_ns(), send_ns = 0, period_ns = 0;
    for (int64_t n = 1; !ended;) {
        if ((int64_t)run.period_ns != period_ns) base_ns = now_ns(), n = 1, period_ns = (int64_t)run.period_ns;
        int64_t cycle_ns = base_ns + (int64_t)((double)(n * (period_ns ? period_ns : 1000000)) / rate);
        wait_until(frame_length && send_ns < cycle_ns ? send_ns : cycle_ns), receive();
        if (frame_length && now_ns() >= send_ns) send_frame();
        int64_t late_ns = now_ns() - cycle_ns;
        if (late_ns < 0) continue;
        for (n++; period_ns && late_ns > period_ns; late_ns -= period_ns, n++, run.overslept++) {
            if (run.begun && run.next <= run.last_tick) missing_command(), move(), run.next++;
            if (!run.begun) sequence++;
        }
        cycle(), send_ns = cycle_ns + (int64_t)(jitter_ns * drand48());
    }
    printf("{\"cycles\": %llu, \"slips\": %llu, \"overslept\": %llu}\n", run.cycles, run.slips, run.overslept);
    return 0;
}
