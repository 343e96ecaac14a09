"""A follower that shares no code with corotate: a rigid body with perfect gyros, in a seat of a run.

Everything it knows of the run comes from the seat's description, `<domain>/<role>.seat.json`. It keeps logical execution
time: command k-1 acts from tick k on; what is late is never applied. It integrates Euler's equations itself, in steps of
half the built-in body's. Must not need any other role to be alive, and must not outlive the run.

Exit codes: 0 the run ended in order, 1 it did not, 2 the seat is not one for this program.
"""

import argparse
import ctypes
import gc
import glob
import importlib.metadata
import json
import math
import os
import shutil
import signal
import sys
import time

import iceoryx2 as iox2

#: How far the body may turn in one integration step, rad.
MAX_STEP_RAD = 1e-3
#: How often it looks for the launcher's word and says how it is, ns; between two looks before its ticks; and for a sample.
TURN_NS = 20_000_000
LOOK_S = 1e-3
NAP_S = 50e-6
#: Wakes so long before a tick and spins the rest, ns.
WAKE_LEAD_NS = 150_000
#: Ticks in lockstep between two words to the launcher.
TURN_TICKS = 256


class SeatError(Exception):
    """The seat is not one that this program can take."""


class RunLost(Exception):
    """The run is gone without a word."""


def structure(described):
    """The ctypes structure of a signal's samples, laid out and named as described."""
    kinds = {"u64": ctypes.c_uint64, "f64": ctypes.c_double}
    fields = described["fields"]
    types = [kinds[field["kind"]] * field["count"] if field["count"] > 1 else kinds[field["kind"]] for field in fields]
    members = {
        "_fields_": [(field["name"], kind) for field, kind in zip(fields, types)],
        "type_name": staticmethod(lambda: described["type_name"]),
    }
    sample = type(described["signal"].capitalize(), (ctypes.Structure,), members)
    laid_out = all(getattr(sample, field["name"]).offset == field["offset"] for field in fields)
    if not laid_out or ctypes.sizeof(sample) != described["size"]:
        raise SeatError(f"{described['service']}: this machine lays {described['type_name']} out differently")
    return sample


class Transport:
    """A node in the run's domain."""

    def __init__(self, described, name):
        version = importlib.metadata.version("iceoryx2")
        if version != described["version"]:
            raise SeatError(f"iceoryx2 {version} is installed and the run has {described['version']}; install that")
        if described["prefix"] is None:
            raise SeatError("the seat names no domain; take the file that `corotate run --external` writes")
        iox2.set_log_level(iox2.LogLevel.Fatal)
        configuration = iox2.config.default()
        configuration.global_cfg.root_path = iox2.Path.new(described["root_path"])
        configuration.global_cfg.prefix = iox2.FileName.new(described["prefix"])
        builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(name)).config(configuration)
        self.node = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)

    def service(self, described, sample):
        """Opens a service, or makes it as every other role would."""
        builder = self.node.service_builder(iox2.ServiceName.new(described["service"])).publish_subscribe(sample)
        for option, value in described["qos"].items():
            builder = getattr(builder, option)(value)
        return builder.open_or_create()


class Writer:
    """The writing end of a signal, with its books."""

    def __init__(self, transport, described):
        self.service = described["service"]
        self.sample = structure(described)()
        factory = transport.service(described, type(self.sample)).publisher_builder()
        self.publisher = factory.backpressure_strategy(iox2.BackpressureStrategy.DiscardData).create()
        self.published, self.skipped, self.last_tick = 0, 0, None
        #: Every sample, byte for byte, where somebody asks for it.
        self.record = None

    def warm_up(self):
        self.publisher.send_copy(type(self.sample)())

    def send(self):
        """Sends the sample as it is filled, under its stamp's tick."""
        self.publisher.send_copy(self.sample)
        self.published += 1
        self.skipped += self.sample.tick - (0 if self.last_tick is None else self.last_tick + 1)
        self.last_tick = self.sample.tick
        if self.record is not None:
            self.record += bytes(self.sample)

    def books(self):
        keys = ("service", "published", "skipped", "last_tick")
        return {key: getattr(self, key) for key in keys}


class Reader:
    """The reading end of a signal, with its books."""

    def __init__(self, transport, described, void_bit):
        self.service = described["service"]
        #: In a generation: of this tick there is no sample.
        self.void_mark = 1 << void_bit
        self.type = structure(described)
        factory = transport.service(described, self.type).subscriber_builder()
        self.subscriber = factory.buffer_size(described["buffer_size"]).create()
        self.sample = None
        self.received, self.gaps, self.stale, self.void = 0, 0, 0, 0
        self.last_tick, self.last_generation = None, None
        #: Every sample, byte for byte, where somebody asks for it.
        self.record = None

    def receive(self):
        """The next sample as it comes, or none."""
        sample = self.subscriber.receive()
        if sample is None:
            return None
        copy = self.type.from_buffer_copy(sample.payload().contents)
        sample.delete()
        return copy

    def newest(self):
        """The last word of a signal of which only that counts."""
        while (sample := self.receive()) is not None:
            self.sample = sample
        return self.sample

    def seek(self, tick):
        """Moves on to the sample of a tick: True if it is at hand, False if it never will be, None if it may still come."""
        while self.last_tick is None or self.last_tick < tick:
            sample = self.receive()
            if sample is None:
                return None
            real = sample.generation != 0 and self.account(sample)
            self.sample = sample if real and not sample.generation & self.void_mark else None
        return self.last_tick == tick and self.sample is not None

    def account(self, sample):
        """Enters a sample into the books; False if it is not newer than the one before."""
        expected = 0
        if self.last_tick is not None:
            known = sample.generation & ~self.void_mark == self.last_generation
            expected = self.last_tick + 1 if known else sample.tick
        if sample.tick < expected:
            self.stale += 1
            return False
        if sample.generation & self.void_mark:
            self.void += 1
        else:
            self.received += 1
        self.gaps += sample.tick - expected
        self.last_tick, self.last_generation = sample.tick, sample.generation & ~self.void_mark
        if self.record is not None:
            self.record += bytes(sample)
        return True

    def books(self):
        keys = ("service", "received", "gaps", "stale", "void", "last_tick")
        return {key: getattr(self, key) for key in keys}


class Body:
    """A rigid body under a held acceleration: Euler's equations in principal axes."""

    RIG = "rigid-body"

    def __init__(self, scenario, name):
        own = next(follower for follower in scenario["follower"] if follower["name"] == name)
        self.factor = own["inertia_factor"]
        i1, i2, i3 = (moment * factor for moment, factor in zip(scenario["leader"]["inertia_kg_m2"], self.factor))
        self.coefficients = ((i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3)
        self.rate = tuple(own["initial_rate_rad_s"])
        #: What the last command asked for, rad/s²: torque over the nominal inertia.
        self.asked = (0.0, 0.0, 0.0)

    def believes(self, command):
        return all(map(math.isfinite, command.acceleration_rad_s2))

    def apply(self, command):
        self.asked = tuple(command.acceleration_rad_s2)

    def apply_safe(self):
        self.asked = (0.0, 0.0, 0.0)

    def measured(self):
        return {"omega_rad_s": self.rate, "applied_rad_s2": self.asked, "valid": 0b111}

    def truth(self):
        return {"omega_rad_s": self.rate, "applied_rad_s2": self.acceleration()}

    def acceleration(self):
        return tuple(asked / factor for asked, factor in zip(self.asked, self.factor))

    def flow(self, dt_s):
        """Moves the body by `dt_s` seconds: classical Runge-Kutta of fourth order in equal steps."""
        acceleration = self.acceleration()
        fastest = max(map(abs, self.rate)) + dt_s * max(map(abs, acceleration))
        steps = max(1, math.ceil(dt_s * fastest / MAX_STEP_RAD))
        h = dt_s / steps
        for _ in range(steps):
            self.rate = self.step(self.rate, acceleration, h)

    def derivative(self, rate, acceleration):
        (a1, a2, a3), (x, y, z), (u1, u2, u3) = self.coefficients, rate, acceleration
        return a1 * y * z + u1, a2 * z * x + u2, a3 * x * y + u3

    def step(self, x, u, h):
        def ahead(slope, part):
            return tuple(value + part * rise for value, rise in zip(x, slope))

        k1 = self.derivative(x, u)
        k2 = self.derivative(ahead(k1, h / 2), u)
        k3 = self.derivative(ahead(k2, h / 2), u)
        k4 = self.derivative(ahead(k3, h), u)
        return tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip(x, k1, k2, k3, k4))


class Actuator:
    """What a body owes its commands: apply in time, hold, go safe after the timeout, re-arm."""

    def __init__(self, body, seat):
        self.body = body
        self.timeout_ticks = seat["command_timeout_ticks"]
        self.latches = seat["rearm"] == "manual"
        self.status_bits = seat["status"]
        self.silent_ticks = 0
        self.safe, self.rejected = False, False

    def take(self, command):
        """Decides the input of a tick: its command, or none. True if one was due and did not come, or is not believed."""
        self.rejected = command is not None and not self.body.believes(command)
        if command is None or self.rejected:
            self.silent_ticks += 1
            if not self.safe and self.silent_ticks >= self.timeout_ticks:
                self.safe = True
                self.body.apply_safe()
            return True
        if not (self.safe and self.latches):
            self.body.apply(command)
            self.silent_ticks, self.safe = 0, False
        return False

    def status(self):
        bits = self.status_bits["rejected"] if self.rejected else 0
        if self.safe:
            return bits | self.status_bits["safe"]
        return bits | (self.status_bits["holding"] if self.silent_ticks > 0 else 0)


class Follower:
    """The role: its links, its ticks, its books."""

    def __init__(self, path, terminated, silent, body):
        with open(path, encoding="utf-8") as file:
            self.seat = seat = json.load(file)
        self.path, self.terminated, self.silent = path, terminated, silent
        if seat["schema"] != "corotate/seat/v1" or seat["kind"] != "plant" or not seat["reads"]:
            raise SeatError(f"{seat['role']} is no driven body described by corotate/seat/v1")
        if seat["scenario"]["rig"] != body.RIG:
            raise SeatError(f"this program is of the rig {body.RIG}, and the run's is {seat['scenario']['rig']}")
        self.transport = Transport(seat["transport"], seat["role"])
        try:
            self.open_links()
        except Exception as error:  # iceoryx2's errors have no ancestor of their own
            raise SeatError(f"cannot open the links of {seat['role']}: {error!r}; is the seat taken?") from error
        self.body = body(seat["scenario"], seat["role"])
        self.actuator = Actuator(self.body, seat)
        self.period_ns, self.last_tick = seat["period_ns"], seat["last_tick"]
        self.timed = seat["clock"] == "realtime"
        self.epoch_ns, self.next_tick, self.next_turn_ns = 0, 0, 0
        self.ticks = {"executed": 0, "missed": 0, "starved": 0, "safe": 0, "first_disturbed": None}
        self.grants = []

    def open_links(self):
        # Before the signals of the loop: whoever has those open and not this one is judged by its samples alone.
        self.health = None if self.silent else Writer(self.transport, self.seat["health"])
        self.measurement, self.truth = (Writer(self.transport, described) for described in self.seat["writes"])
        void_bit = self.seat["void_bit"]
        (self.command,) = (Reader(self.transport, described, void_bit) for described in self.seat["reads"])
        self.schedule = Reader(self.transport, self.seat["schedule"], void_bit)

    def run(self):
        """From open links to the end of the run."""
        if self.await_phase("open", "warm_up") and self.warm_up() and self.await_phase("ready", "run"):
            self.epoch_ns = self.schedule.newest().epoch_ns
            self.realtime() if self.timed else self.lockstep()
        if not self.silent:
            self.report()
        # Samples may still wait to be read: the links stay open until everybody is done.
        while self.next_tick > self.last_tick and not self.stopped():
            self.announce("done")
            self.refresh()
            time.sleep(LOOK_S)

    def await_phase(self, state, phase):
        """Announces a state until the launcher says a phase; False if the run was stopped before."""
        while not self.stopped():
            self.announce(state)
            word = self.schedule.newest()
            if word is not None and word.phase >= self.seat["phases"][phase]:
                return True
            time.sleep(LOOK_S)
        return False

    def warm_up(self):
        for _ in range(self.seat["warm_up"]["samples"]):
            while self.command.receive() is not None:
                pass
            self.measurement.warm_up()
            self.truth.warm_up()
            time.sleep(self.seat["warm_up"]["pause_ns"] / 1e9)
        return True

    def realtime(self):
        """Ticks on the absolute grid; what is late is skipped, never made up for in a burst."""
        self.ask_for_priority()
        while self.next_tick <= self.last_tick:
            if not self.idle_until(self.epoch_ns + self.next_tick * self.period_ns):
                return
            due = (time.monotonic_ns() - self.epoch_ns) // self.period_ns
            self.skip_to(min(due, self.last_tick + 1))
            if self.next_tick <= self.last_tick:
                self.tick()
            if self.turn():
                return

    def idle_until(self, due_ns):
        """Sleeps, then spins, until an instant; False if the run was stopped meanwhile."""
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            if left_ns > WAKE_LEAD_NS:
                time.sleep(min(left_ns - WAKE_LEAD_NS, TURN_NS) / 1e9)
                if left_ns > TURN_NS and self.turn():
                    return False
        return True

    def turn(self):
        """Now and then: how this role is, and whether the run is over."""
        if time.monotonic_ns() < self.next_turn_ns:
            return False
        self.next_turn_ns = time.monotonic_ns() + TURN_NS
        self.announce("running")
        self.refresh()
        return self.stopped()

    def refresh(self):
        """Lets roles that were started anew have what they still lack: in lockstep the loop waits for them."""
        for writer in (self.measurement, self.truth):
            writer.publisher.update_connections()

    def lockstep(self):
        """Ticks by the inputs alone, at most the window ahead of the slowest consumer."""
        idle = 0
        while self.next_tick <= self.last_tick:
            credit = self.schedule.newest().credit_tick + self.seat["window_ticks"]
            ready = self.next_tick == 0 or self.command.seek(self.next_tick - 1) is not None
            if ready and self.next_tick <= credit:
                idle = 0
                self.tick()
                if self.next_tick % TURN_TICKS == 0:
                    self.announce("running")
                continue
            idle += 1
            if idle > 50:
                time.sleep(NAP_S)
            if self.turn():
                return

    def tick(self):
        """One tick: the command in, measurement and truth out, and then the body moves on."""
        tick = self.next_tick
        if tick > 0:
            in_time = self.command.seek(tick - 1)
            if self.actuator.take(self.command.sample if in_time else None):
                self.ticks["starved"] += 1
                self.disturbed(tick)
        self.ticks["safe"] += self.actuator.safe
        self.publish(self.measurement, self.body.measured())
        self.publish(self.truth, self.body.truth())
        self.body.flow(self.period_ns / 1e9)
        self.ticks["executed"] += 1
        self.next_tick += 1

    def publish(self, writer, values):
        sample = writer.sample
        sample.tick, sample.generation = self.next_tick, 1
        sample.origin_ns = self.epoch_ns + self.next_tick * self.period_ns
        sample.status = self.actuator.status()
        for name, value in values.items():
            setattr(sample, name, value)
        sample.sent_ns = time.monotonic_ns() if self.timed else 0
        writer.send()

    def skip_to(self, tick):
        """Counts the ticks before `tick` as missed; the body moves through them all the same."""
        for _ in range(self.next_tick, tick):
            self.disturbed(self.next_tick)
            self.ticks["missed"] += 1
            self.next_tick += 1
            self.body.flow(self.period_ns / 1e9)

    def disturbed(self, tick):
        if self.ticks["first_disturbed"] is None:
            self.ticks["first_disturbed"] = tick

    def announce(self, state):
        """Tells the launcher how this role is, if it does so at all."""
        if self.silent:
            return
        sample = self.health.sample
        sample.tick, sample.generation = self.next_tick, 1
        sample.origin_ns = sample.sent_ns = time.monotonic_ns()
        sample.state = self.seat["states"][state]
        sample.executed, sample.missed = self.ticks["executed"], self.ticks["missed"]
        sample.denied = sum(not grant["granted"] for grant in self.grants)
        self.health.publisher.send_copy(sample)

    def stopped(self):
        """Whether the run is over for this role. The launcher says so before it removes the domain."""
        # Not the domain's directory: the transport makes that anew for whoever comes too late.
        gone = not os.path.exists(self.path)
        word = self.schedule.newest()
        if self.terminated or (word is not None and word.phase >= self.seat["phases"]["stop"]):
            return True
        if gone:
            raise RunLost(f"{self.path} is gone: the run is over")
        return False

    def ask_for_priority(self):
        """Runs before all ordinary processes where that is granted; what is not is reported, and done without."""
        asked = self.seat["scenario"]["realtime"]["priority"] - 1
        if asked <= 0:
            return
        grant = {"privilege": "SCHED_FIFO", "asked": str(asked), "granted": True, "reason": ""}
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(asked))
        except OSError as error:
            reason = f"{error.strerror}; raise the rtprio limit (ulimit -r) or grant CAP_SYS_NICE"
            grant.update(granted=False, reason=reason)
        self.grants.append(grant)

    def report(self):
        """Leaves the books, whole, where the launcher looks for them."""
        books = {
            "role": self.seat["role"],
            "ticks": {"elapsed": self.next_tick, **self.ticks},
            "written": [self.measurement.books(), self.truth.books()],
            "read": [self.command.books()],
            "grants": self.grants,
        }
        part = self.seat["report"] + ".part"
        with open(part, "w", encoding="utf-8") as file:
            json.dump(books, file)
        os.replace(part, self.seat["report"])

    def loop_ends(self):
        return {"measurement": self.measurement, "truth": self.truth, "command": self.command}

    def record(self):
        """Keeps every sample that is published or received from now on."""
        for end in self.loop_ends().values():
            end.record = bytearray()

    def leave_record(self, directory):
        """Leaves what was kept, one file per signal."""
        os.makedirs(directory, exist_ok=True)
        for name, end in self.loop_ends().items():
            with open(os.path.join(directory, f"{name}.bin"), "wb") as file:
                file.write(end.record)


def forget(transport):
    """Removes what the transport made anew in a domain that was gone when this program came."""
    domain = transport["domain"]
    if os.path.exists(domain + ".lock"):
        return
    shutil.rmtree(domain, ignore_errors=True)
    for path in glob.glob(f"/dev/shm/{transport['prefix']}*"):
        os.remove(path)
    try:
        os.rmdir(os.path.dirname(domain))
    except OSError:
        pass  # Other runs live there.


def main(body=Body):
    parser = argparse.ArgumentParser(description="A follower in a seat of a corotate run.")
    parser.add_argument("seat", help="the seat's description, as the waiting run prints its path")
    parser.add_argument("--record", metavar="DIR", help="leave every sample published and received there")
    parser.add_argument("--silent", action="store_true", help="say nothing of itself, as hardware may: samples only")
    arguments = parser.parse_args()
    terminated = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _frame: terminated.append(number))
    try:
        follower = Follower(arguments.seat, terminated, arguments.silent, body)
        if arguments.record:
            follower.record()
        # What is made from now on is freed by reference counts; a collection would cost ticks.
        gc.freeze()
        gc.disable()
        follower.run()
        if arguments.record:
            follower.leave_record(arguments.record)
    except KeyError as error:
        print(f"follower: {arguments.seat} is no seat: it lacks {error}", file=sys.stderr)
        return 2
    except (SeatError, OSError, ValueError) as error:
        print(f"follower: {arguments.seat}: {error}", file=sys.stderr)
        return 2
    except RunLost as error:
        print(f"follower: {error}", file=sys.stderr)
        transport = follower.seat["transport"]
        del follower
        forget(transport)
        return 1
    return 128 + terminated[0] if terminated else 0


if __name__ == "__main__":
    sys.exit(main())
