/* The controller of examples/motor-pair in C: the follower accelerates as the leader does, and against its own error.
 *
 *     controller DOMAIN-OR-SEAT
 */
#include "controller.h" /* motor-pair seat motor-pair controller --header */
#include "corotate.h"
#include <stdio.h>

static const double inertia_kg_m2 = 1e-3, friction_n_m_s = 2e-3, torque_n_m_per_a = 5e-2;

int main(int count, char **words) {
    corotate_seat seat = 0;
    int got = count == 2 ? corotate_seat_open(words[1], "controller", &seat) : COROTATE_BAD_ARGUMENT;
    while (got >= 0 && (got = corotate_seat_wait(seat)) == COROTATE_TICK) {
        struct corotate_leader_estimate leader;
        struct corotate_follower_measurement own;
        struct corotate_follower_command command;
        double gain_per_s;
        int estimated = corotate_seat_read(seat, "estimate", &leader, sizeof leader);
        int measured = corotate_seat_read(seat, "measurement", &own, sizeof own);
        got = corotate_seat_value(seat, "motor.gain_per_s", &gain_per_s, 1); /* follows `corotate set` */
        if (estimated != COROTATE_OK || measured != COROTATE_OK || got < 0)
            continue; /* a missing sample, or an error that the loop ends with */
        double rise_rad_s2 = leader.rise_rad_s2 - gain_per_s * (own.speed_rad_s - leader.speed_rad_s);
        command.current_a = (inertia_kg_m2 * rise_rad_s2 + friction_n_m_s * own.speed_rad_s) / torque_n_m_per_a;
        got = corotate_seat_write(seat, "command", &command, sizeof command);
    }
    if (got < 0)
        fprintf(stderr, "controller: %s\n", count == 2 ? corotate_last_error() : "name the seat's file or its directory");
    corotate_seat_close(seat);
    return got < 0;
}
