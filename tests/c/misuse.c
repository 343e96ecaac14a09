/* Every misuse of libcorotate that needs no luck; each must return the right number. Built with sanitizers.
 *
 *     misuse SEAT
 */
#include "controller.h"
#include "corotate.h"
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPECT(call, expected)                                                                                                     \
    do {                                                                                                                           \
        int got = (call);                                                                                                          \
        if (got != (expected)) {                                                                                                   \
            fprintf(stderr, "line %d: %s is %d, not %d: %s\n", __LINE__, #call, got, (expected), corotate_last_error());            \
            exit(1);                                                                                                               \
        }                                                                                                                          \
    } while (0)

static corotate_seat seat;
static int waited;

/* Waits in another thread, for which the first thread may find the seat busy. */
static void *wait_for_tick(void *unused) {
    (void)unused;
    waited = corotate_seat_wait(seat);
    return NULL;
}

int main(int count, char **words) {
    if (count != 2)
        return 2;
    struct corotate_follower_command command = {0};
    struct corotate_leader_estimate estimate;
    corotate_seat none = 0;
    double number = 0.0;
    if (corotate_abi_version() != COROTATE_ABI_VERSION || strlen(corotate_last_error()) != 0)
        return 3;
    EXPECT(corotate_seat_open(NULL, "controller", &seat), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_open(words[1], NULL, &seat), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_open(words[1], "controller", NULL), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_open("/nowhere", "controller", &seat), COROTATE_NO_SEAT);
    EXPECT(corotate_seat_open(words[1], "observer", &seat), COROTATE_NO_SEAT);
    EXPECT(corotate_seat_wait(none), COROTATE_CLOSED);
    EXPECT(corotate_seat_close(none), COROTATE_CLOSED);
    EXPECT(corotate_seat_close(UINT64_MAX), COROTATE_CLOSED);
    EXPECT(corotate_seat_open(words[1], "controller", &seat), COROTATE_OK);
    EXPECT(corotate_seat_read(seat, "estimate", &estimate, sizeof estimate), COROTATE_WRONG_ORDER);
    EXPECT(corotate_seat_write(seat, "command", &command, sizeof command), COROTATE_WRONG_ORDER);
    EXPECT(corotate_seat_fail(seat, "too early"), COROTATE_WRONG_ORDER);
    EXPECT(corotate_seat_wait(seat), COROTATE_TICK);
    EXPECT(corotate_seat_read(seat, "estimate", NULL, sizeof estimate), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_read(seat, NULL, &estimate, sizeof estimate), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_read(seat, "\xff", &estimate, sizeof estimate), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_read(seat, "estimate", &estimate, sizeof estimate - 8), COROTATE_WRONG_SIZE);
    EXPECT(corotate_seat_read(seat, "truth", &estimate, sizeof estimate), COROTATE_NO_SUCH_NAME);
    EXPECT(corotate_seat_read(seat, "command", &command, sizeof command), COROTATE_NO_SUCH_NAME);
    EXPECT(corotate_seat_write(seat, "estimate", &estimate, sizeof estimate), COROTATE_NO_SUCH_NAME);
    EXPECT(corotate_seat_write(seat, "command", &command, 0), COROTATE_WRONG_SIZE);
    EXPECT(corotate_seat_write(seat, "command", NULL, sizeof command), COROTATE_BAD_ARGUMENT);
    EXPECT(corotate_seat_value(seat, "motor.gain_per_s", &number, 2), COROTATE_WRONG_SIZE);
    EXPECT(corotate_seat_value(seat, "motor.nothing", &number, 1), COROTATE_NO_SUCH_NAME);
    EXPECT(corotate_seat_value(seat, "motor.gain_per_s", &number, 1), COROTATE_OK);
    EXPECT(corotate_seat_tick(seat, NULL, NULL), COROTATE_OK);
    EXPECT(corotate_seat_read(seat, "leader/estimate", &estimate, sizeof estimate), COROTATE_OK);
    EXPECT(corotate_seat_write(seat, "follower/command", &command, sizeof command), COROTATE_OK);
    /* One thread waits for the next tick meanwhile. */
    pthread_t thread;
    if (pthread_create(&thread, NULL, wait_for_tick, NULL) != 0)
        return 4;
    for (int tries = 0; tries < 1000; tries++) {
        int got = corotate_seat_tick(seat, NULL, NULL);
        if (got != COROTATE_OK && got != COROTATE_BUSY)
            return 5;
    }
    if (pthread_join(thread, NULL) != 0 || waited != COROTATE_TICK)
        return 6;
    EXPECT(corotate_seat_fail(seat, "the end of the trial"), COROTATE_OK);
    EXPECT(corotate_seat_wait(seat), COROTATE_RUN_FAILED);
    EXPECT(corotate_seat_wait(seat), COROTATE_WRONG_ORDER);
    EXPECT(corotate_seat_close(seat), COROTATE_OK);
    EXPECT(corotate_seat_close(seat), COROTATE_CLOSED);
    EXPECT(corotate_seat_read(seat, "estimate", &estimate, sizeof estimate), COROTATE_CLOSED);
    return 0;
}
