// The follower of examples/motor-pair in C++: a DC motor under the commanded current.
//
//     follower DOMAIN-OR-SEAT
#include "corotate.h"
#include "follower.h" // motor-pair seat motor-pair follower --header
#include <cmath>
#include <cstdio>
#include <stdexcept>

constexpr double inertia_kg_m2 = 1e-3, friction_n_m_s = 2e-3, torque_n_m_per_a = 5e-2;

// An open seat; it is given up at the end of the block.
class Seat {
  public:
    Seat(const char *path, const char *role) { check(corotate_seat_open(path, role, &seat)); }
    ~Seat() { corotate_seat_close(seat); }
    Seat(const Seat &) = delete;
    Seat &operator=(const Seat &) = delete;
    bool wait() { return check(corotate_seat_wait(seat)) == COROTATE_TICK; }
    template <class Sample> bool read(const char *signal, Sample &sample) {
        return check(corotate_seat_read(seat, signal, &sample, sizeof sample)) == COROTATE_OK;
    }
    template <class Sample> void write(const char *signal, const Sample &sample) {
        check(corotate_seat_write(seat, signal, &sample, sizeof sample));
    }
    double period_s() {
        double period_s = 0;
        check(corotate_seat_grid(seat, &period_s, nullptr));
        return period_s;
    }

  private:
    corotate_seat seat = 0;
    static int check(int got) { return got < 0 ? throw std::runtime_error(corotate_last_error()) : got; }
};

int main(int count, char **words) try {
    if (count != 2)
        throw std::runtime_error("name the seat's file or its directory");
    Seat seat(words[1], "follower");
    const double decay = std::exp(-(friction_n_m_s / inertia_kg_m2) * seat.period_s());
    corotate_follower_command command{};
    corotate_follower_measurement state{};
    while (seat.wait()) {
        seat.read("command", command); // without a new command the motor holds the last one
        state.current_a = command.current_a;
        seat.write("measurement", state); // the truth is the same
        const double end_rad_s = (torque_n_m_per_a * state.current_a) / friction_n_m_s;
        state.speed_rad_s = end_rad_s + (state.speed_rad_s - end_rad_s) * decay;
    }
} catch (const std::exception &error) {
    std::fprintf(stderr, "follower: %s\n", error.what());
    return 1;
}
