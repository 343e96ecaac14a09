/* The law of tests/data/carts.rs: the follower's own estimate is read, the other cart has none.
 *
 *     carts SEAT
 */
#include "carts.h" /* carts seat carts controller --header */
#include "corotate.h"
#include <stdio.h>

static double rise_m_s2(const struct corotate_leader_estimate *leader, double position_m, double speed_m_s) {
    return 4.0 * (leader->position_m - position_m) + 4.0 * (leader->speed_m_s - speed_m_s);
}

int main(int count, char **words) {
    corotate_seat seat = 0;
    int got = count == 2 ? corotate_seat_open(words[1], "controller", &seat) : COROTATE_BAD_ARGUMENT;
    while (got >= 0 && (got = corotate_seat_wait(seat)) == COROTATE_TICK) {
        struct corotate_leader_estimate leader;
        struct corotate_follower_estimate own;
        struct corotate_other_measurement other;
        struct corotate_follower_command follower_command;
        struct corotate_other_command other_command;
        if (corotate_seat_read(seat, "leader/estimate", &leader, sizeof leader) != COROTATE_OK ||
            corotate_seat_read(seat, "follower/estimate", &own, sizeof own) != COROTATE_OK ||
            corotate_seat_read(seat, "other/measurement", &other, sizeof other) != COROTATE_OK)
            continue;
        follower_command.rise_m_s2 = rise_m_s2(&leader, own.position_m, own.speed_m_s);
        other_command.rise_m_s2 = rise_m_s2(&leader, other.position_m, leader.speed_m_s);
        got = corotate_seat_write(seat, "follower/command", &follower_command, sizeof follower_command);
        if (got >= 0)
            got = corotate_seat_write(seat, "other/command", &other_command, sizeof other_command);
    }
    if (got < 0)
        fprintf(stderr, "carts: %s\n", corotate_last_error());
    corotate_seat_close(seat);
    return got < 0;
}
