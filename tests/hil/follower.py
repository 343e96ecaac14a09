"""A foreign follower that shares no code with corotate: a rigid body with perfect gyros.

It takes its role in a run from the seat file `<domain>/<role>.seat.json` alone. It keeps logical execution time: command k-1
acts from tick k on, and a late command is never applied. It integrates Euler's equations in half the steps of the built-in
body. Must not require that any other role is alive, and must not outlive the run.

Exit codes: 0 the run ended in order, 1 it did not, 2 the seat does not suit this program.
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

#: Largest rotation in one integration step, rad.
MAX_STEP_RAD = 1e-3
#: Interval of heartbeats and of checks for the launcher's announcements, ns.
STATUS_NS = 20_000_000
#: Pauses before and after the ticks, and while a sample is missing, s.
POLL_S = 1e-3
SAMPLE_POLL_S = 50e-6
#: Time before a tick at which it wakes; it spins until the tick, ns.
WAKE_LEAD_NS = 150_000
#: Ticks between two heartbeats in lockstep.
STATUS_TICKS = 256


class SeatError(Exception):
    """This program cannot take the seat."""


class RunLost(Exception):
    """The run is gone without an announcement."""


def structure(described):
    """Returns the ctypes structure of a signal's samples, as the seat describes it."""
    kinds = {"u64": ctypes.c_uint64, "f64": ctypes.c_double}
    fields = described["fields"]
    types = [kinds[field["kind"]] * field["count"] if field["count"] > 1 else kinds[field["kind"]] for field in fields]
    members = {
        "_fields_": [(field["name"], kind) for field, kind in zip(fields, types)],
        "type_name": staticmethod(lambda: described["type_name"]),
    }
    sample = type(described["signal"].capitalize(), (ctypes.Structure,), members)
    fits = all(getattr(sample, field["name"]).offset == field["offset"] for field in fields)
    if not fits or ctypes.sizeof(sample) != described["size"]:
        raise SeatError(f"{described['service']}: the layout of {described['type_name']} differs on this machine")
    return sample


class Transport:
    """A node in the run's domain."""

    def __init__(self, described, name):
        version = importlib.metadata.version("iceoryx2")
        if version != described["version"]:
            raise SeatError(f"iceoryx2 {version} is installed; install {described['version']}, which the run uses")
        if described["prefix"] is None:
            raise SeatError("the seat has no domain; use the file that `corotate run --external` writes")
        iox2.set_log_level(iox2.LogLevel.Fatal)
        configuration = iox2.config.default()
        configuration.global_cfg.root_path = iox2.Path.new(described["root_path"])
        configuration.global_cfg.prefix = iox2.FileName.new(described["prefix"])
        builder = iox2.NodeBuilder.new().name(iox2.NodeName.new(name)).config(configuration)
        self.node = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled).create(iox2.ServiceType.Ipc)

    def service(self, described, sample):
        """Opens a service, or creates it with the settings that all roles use."""
        builder = self.node.service_builder(iox2.ServiceName.new(described["service"])).publish_subscribe(sample)
        for option, value in described["qos"].items():
            builder = getattr(builder, option)(value)
        return builder.open_or_create()


class Writer:
    """The writing end of a signal, with its counters."""

    def __init__(self, transport, described):
        self.service = described["service"]
        self.sample = structure(described)()
        factory = transport.service(described, type(self.sample)).publisher_builder()
        self.publisher = factory.backpressure_strategy(iox2.BackpressureStrategy.DiscardData).create()
        self.published, self.skipped, self.last_tick = 0, 0, None
        #: The bytes of all samples, with --record.
        self.record = None

    def warm_up(self):
        self.publisher.send_copy(type(self.sample)())

    def send(self):
        """Sends the current sample."""
        self.publisher.send_copy(self.sample)
        self.published += 1
        self.skipped += self.sample.tick - (0 if self.last_tick is None else self.last_tick + 1)
        self.last_tick = self.sample.tick
        if self.record is not None:
            self.record += bytes(self.sample)

    def counters(self):
        keys = ("service", "published", "skipped", "last_tick")
        return {key: getattr(self, key) for key in keys}


class Reader:
    """The reading end of a signal, with its counters."""

    def __init__(self, transport, described, void_bit):
        self.service = described["service"]
        #: Bit in a generation that marks a tick without a sample.
        self.void_mark = 1 << void_bit
        self.type = structure(described)
        factory = transport.service(described, self.type).subscriber_builder()
        self.subscriber = factory.buffer_size(described["buffer_size"]).create()
        self.sample = None
        self.received, self.gaps, self.stale, self.void = 0, 0, 0, 0
        self.last_tick, self.last_generation = None, None
        #: The bytes of all samples, with --record.
        self.record = None

    def receive(self):
        """Returns the next sample in order of arrival, or None."""
        sample = self.subscriber.receive()
        if sample is None:
            return None
        copy = self.type.from_buffer_copy(sample.payload().contents)
        sample.delete()
        return copy

    def newest(self):
        """Returns the newest sample of a signal whose older samples do not matter."""
        while (sample := self.receive()) is not None:
            self.sample = sample
        return self.sample

    def seek(self, tick):
        """Moves to the sample of a tick. Returns True if it has arrived, False if it is missing, None if it may still arrive."""
        while self.last_tick is None or self.last_tick < tick:
            sample = self.receive()
            if sample is None:
                return None
            newer = sample.generation != 0 and self.account(sample)
            self.sample = sample if newer and not sample.generation & self.void_mark else None
        return self.last_tick == tick and self.sample is not None

    def account(self, sample):
        """Counts a sample. Returns False if it is not newer than the previous one."""
        expected = 0
        if self.last_tick is not None:
            same_writer = sample.generation & ~self.void_mark == self.last_generation
            expected = self.last_tick + 1 if same_writer else sample.tick
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

    def counters(self):
        keys = ("service", "received", "gaps", "stale", "void", "last_tick")
        return {key: getattr(self, key) for key in keys}


class Body:
    """A rigid body under a constant acceleration: Euler's equations in principal axes."""

    RIG = "rigid-body"

    def __init__(self, scenario, name):
        own = next(follower for follower in scenario["follower"] if follower["name"] == name)
        self.factor = own["inertia_factor"]
        i1, i2, i3 = (moment * factor for moment, factor in zip(scenario["leader"]["inertia_kg_m2"], self.factor))
        self.coefficients = ((i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3)
        self.rate = tuple(own["initial_rate_rad_s"])
        #: The last command, rad/s²: torque over the nominal inertia.
        self.commanded = (0.0, 0.0, 0.0)

    def accepts(self, command):
        return all(map(math.isfinite, command.acceleration_rad_s2))

    def apply(self, command):
        self.commanded = tuple(command.acceleration_rad_s2)

    def apply_safe(self):
        self.commanded = (0.0, 0.0, 0.0)

    def measured(self):
        return {"omega_rad_s": self.rate, "applied_rad_s2": self.commanded, "valid": 0b111}

    def truth(self):
        return {"omega_rad_s": self.rate, "applied_rad_s2": self.acceleration()}

    def acceleration(self):
        return tuple(commanded / factor for commanded, factor in zip(self.commanded, self.factor))

    def flow(self, dt_s):
        """Integrates over `dt_s` seconds with the classical Runge-Kutta method in equal steps."""
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
        def advance(slope, duration):
            return tuple(value + duration * rise for value, rise in zip(x, slope))

        k1 = self.derivative(x, u)
        k2 = self.derivative(advance(k1, h / 2), u)
        k3 = self.derivative(advance(k2, h / 2), u)
        k4 = self.derivative(advance(k3, h), u)
        return tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip(x, k1, k2, k3, k4))


class Actuator:
    """Applies commands: holds the last one, goes safe after the timeout, re-arms."""

    def __init__(self, body, seat):
        self.body = body
        self.timeout_ticks = seat["command_timeout_ticks"]
        self.latches = seat["rearm"] == "manual"
        self.status_bits = seat["status"]
        self.missing_ticks = 0
        self.safe, self.rejected = False, False

    def take(self, command):
        """Applies the command of a tick, or None. Returns True if it is missing or rejected."""
        self.rejected = command is not None and not self.body.accepts(command)
        if command is None or self.rejected:
            self.missing_ticks += 1
            if not self.safe and self.missing_ticks >= self.timeout_ticks:
                self.safe = True
                self.body.apply_safe()
            return True
        if not (self.safe and self.latches):
            self.body.apply(command)
            self.missing_ticks, self.safe = 0, False
        return False

    def status(self):
        bits = self.status_bits["rejected"] if self.rejected else 0
        if self.safe:
            return bits | self.status_bits["safe"]
        return bits | (self.status_bits["holding"] if self.missing_ticks > 0 else 0)


class Follower:
    """The role with its links, ticks and counters."""

    def __init__(self, path, terminated, silent, body):
        with open(path, encoding="utf-8") as file:
            self.seat = seat = json.load(file)
        self.path, self.terminated, self.silent = path, terminated, silent
        if seat["schema"] != "corotate/seat/v1" or seat["kind"] != "plant" or not seat["reads"]:
            raise SeatError(f"{seat['role']} is not a driven body described by corotate/seat/v1")
        if seat["scenario"]["rig"] != body.RIG:
            raise SeatError(f"this program supports the rig {body.RIG}, not {seat['scenario']['rig']}")
        self.transport = Transport(seat["transport"], seat["role"])
        try:
            self.open_links()
        except Exception as error:  # iceoryx2's errors have no common base class
            raise SeatError(f"cannot open the links of {seat['role']}: {error!r}; check that no other program has the role") from error
        self.body = body(seat["scenario"], seat["role"])
        self.actuator = Actuator(self.body, seat)
        self.period_ns, self.last_tick = seat["period_ns"], seat["last_tick"]
        self.timed = seat["clock"] == "realtime"
        self.epoch_ns, self.next_tick, self.next_status_ns = 0, 0, 0
        self.ticks = {"executed": 0, "missed": 0, "starved": 0, "safe": 0, "first_disturbed": None}
        self.grants = []

    def open_links(self):
        # Before the signals of the loop: the launcher judges a role without heartbeats by its samples alone.
        self.health = None if self.silent else Writer(self.transport, self.seat["health"])
        self.measurement, self.truth = (Writer(self.transport, described) for described in self.seat["writes"])
        void_bit = self.seat["void_bit"]
        (self.command,) = (Reader(self.transport, described, void_bit) for described in self.seat["reads"])
        self.schedule = Reader(self.transport, self.seat["schedule"], void_bit)
        self.input, self.changes = Reader(self.transport, self.seat["input"], void_bit), []

    def run(self):
        """Runs the role until the run ends."""
        if self.await_phase("open", "warm_up") and self.warm_up() and self.await_phase("ready", "run"):
            self.epoch_ns = self.schedule.newest().epoch_ns
            self.realtime() if self.timed else self.lockstep()
        if not self.silent:
            self.report()
        # The links stay open until the run stops, because other roles may still read samples.
        while self.next_tick > self.last_tick and not self.stopped():
            self.announce("done")
            self.refresh()
            time.sleep(POLL_S)

    def await_phase(self, state, phase):
        """Publishes a state until the launcher announces a phase. Returns False if the run stops first."""
        while not self.stopped():
            self.announce(state)
            schedule = self.schedule.newest()
            if schedule is not None and schedule.phase >= self.seat["phases"][phase]:
                return True
            time.sleep(POLL_S)
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
        """Executes ticks on the absolute grid; skips late ones instead of executing them in a burst."""
        self.request_priority()
        while self.next_tick <= self.last_tick:
            if not self.idle_until(self.epoch_ns + self.next_tick * self.period_ns):
                return
            due = (time.monotonic_ns() - self.epoch_ns) // self.period_ns
            self.skip_to(min(due, self.last_tick + 1))
            if self.next_tick <= self.last_tick:
                self.tick()
            if self.publish_status():
                return

    def idle_until(self, due_ns):
        """Sleeps, then spins, until a time. Returns False if the run stops first."""
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            if left_ns > WAKE_LEAD_NS:
                time.sleep(min(left_ns - WAKE_LEAD_NS, STATUS_NS) / 1e9)
                if left_ns > STATUS_NS and self.publish_status():
                    return False
        return True

    def publish_status(self):
        """Publishes a heartbeat when it is due. Returns True if the run is over."""
        if time.monotonic_ns() < self.next_status_ns:
            return False
        self.next_status_ns = time.monotonic_ns() + STATUS_NS
        self.announce("running")
        self.refresh()
        return self.stopped()

    def refresh(self):
        """Delivers retained samples to restarted roles, for which the loop waits in lockstep."""
        for writer in (self.measurement, self.truth):
            writer.publisher.update_connections()

    def lockstep(self):
        """Executes each tick once its command has arrived, at most the window ahead of the slowest reader."""
        idle = 0
        while self.next_tick <= self.last_tick:
            credit = self.schedule.newest().credit_tick + self.seat["window_ticks"]
            ready = self.next_tick == 0 or self.command.seek(self.next_tick - 1) is not None
            if ready and self.next_tick <= credit:
                idle = 0
                self.tick()
                if self.next_tick % STATUS_TICKS == 0:
                    self.announce("running")
                continue
            idle += 1
            if idle > 50:
                time.sleep(SAMPLE_POLL_S)
            if self.publish_status():
                return

    def tick(self):
        """Executes a tick: applies the command, publishes measurement and truth, integrates."""
        tick = self.next_tick
        if tick > 0:
            in_time = self.command.seek(tick - 1)
            if self.actuator.take(self.command.sample if in_time else None):
                self.ticks["starved"] += 1
                self.note_disturbed(tick)
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
        """Counts the ticks before `tick` as missed, and integrates over them."""
        for _ in range(self.next_tick, tick):
            self.note_disturbed(self.next_tick)
            self.ticks["missed"] += 1
            self.next_tick += 1
            self.body.flow(self.period_ns / 1e9)

    def note_disturbed(self, tick):
        if self.ticks["first_disturbed"] is None:
            self.ticks["first_disturbed"] = tick

    def announce(self, state):
        """Publishes a heartbeat, unless --silent."""
        if self.silent:
            return
        sample = self.health.sample
        sample.tick, sample.generation = self.next_tick, 1
        sample.origin_ns = sample.sent_ns = time.monotonic_ns()
        sample.state = self.seat["states"][state]
        sample.executed, sample.missed = self.ticks["executed"], self.ticks["missed"]
        sample.denied = sum(not grant["granted"] for grant in self.grants)
        self.health.publisher.send_copy(sample)

    def take_changes(self):
        """Keeps the changes of inputs that have arrived: number, tick, key and values."""
        while (change := self.input.receive()) is not None:
            described = self.seat["inputs"][change.input]
            values = list(change.values)[: described["components"]]
            self.changes.append([change.number, change.tick, described["key"], values])

    def stopped(self):
        """Returns True if the run is over. The launcher announces that before it removes the domain."""
        # Not the domain's directory, because the transport creates it again for a late program.
        gone = not os.path.exists(self.path)
        self.take_changes()
        schedule = self.schedule.newest()
        if self.terminated or (schedule is not None and schedule.phase >= self.seat["phases"]["stop"]):
            return True
        if gone:
            raise RunLost(f"{self.path} is gone: the run is over")
        return False

    def request_priority(self):
        """Requests real-time priority, and reports whether it was granted."""
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
        """Writes the report for the launcher in one step."""
        report = {
            "role": self.seat["role"],
            "ticks": {"elapsed": self.next_tick, **self.ticks},
            "written": [self.measurement.counters(), self.truth.counters()],
            "read": [self.command.counters()],
            "grants": self.grants,
        }
        partial = self.seat["report"] + ".part"
        with open(partial, "w", encoding="utf-8") as file:
            json.dump(report, file)
        os.replace(partial, self.seat["report"])

    def loop_links(self):
        return {"measurement": self.measurement, "truth": self.truth, "command": self.command}

    def record(self):
        """Keeps all samples that are published or received from now on."""
        for link in self.loop_links().values():
            link.record = bytearray()

    def write_record(self, directory):
        """Writes the kept samples, one file per signal."""
        os.makedirs(directory, exist_ok=True)
        for name, link in self.loop_links().items():
            with open(os.path.join(directory, f"{name}.bin"), "wb") as file:
                file.write(link.record)


def remove_files(transport):
    """Removes the files that the transport created in a domain that no longer existed."""
    domain = transport["domain"]
    if os.path.exists(domain + ".lock"):
        return
    shutil.rmtree(domain, ignore_errors=True)
    for path in glob.glob(f"/dev/shm/{transport['prefix']}*"):
        os.remove(path)
    try:
        os.rmdir(os.path.dirname(domain))
    except OSError:
        pass  # Other runs use it.


def main(body=Body):
    parser = argparse.ArgumentParser(description="Take the role of a follower in a corotate run.")
    parser.add_argument("seat", help="the seat file whose path the waiting run prints")
    parser.add_argument("--record", metavar="DIR", help="write all samples published and received to DIR")
    parser.add_argument("--changes", metavar="FILE", help="write the changes of inputs that it received to FILE")
    parser.add_argument("--silent", action="store_true", help="send samples only, no heartbeats and no report")
    arguments = parser.parse_args()
    terminated = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _frame: terminated.append(number))
    try:
        follower = Follower(arguments.seat, terminated, arguments.silent, body)
        if arguments.record:
            follower.record()
        # Reference counts free the objects of the loop; a garbage collection would miss ticks.
        gc.freeze()
        gc.disable()
        follower.run()
        if arguments.record:
            follower.write_record(arguments.record)
        if arguments.changes:
            with open(arguments.changes, "w", encoding="utf-8") as file:
                json.dump(follower.changes, file)
    except KeyError as error:
        print(f"follower: {arguments.seat} is not a seat file: {error} is missing", file=sys.stderr)
        return 2
    except (SeatError, OSError, ValueError) as error:
        print(f"follower: {arguments.seat}: {error}", file=sys.stderr)
        return 2
    except RunLost as error:
        print(f"follower: {error}", file=sys.stderr)
        transport = follower.seat["transport"]
        del follower
        remove_files(transport)
        return 1
    return 128 + terminated[0] if terminated else 0


if __name__ == "__main__":
    sys.exit(main())
