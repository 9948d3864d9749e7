"""CAN frames to EgoState: checked, plausible, timed out by message time. Pure: time comes with the frames."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from tmde_edge.canbus import gps
from tmde_edge.canbus.checks import RULES, CounterState
from tmde_edge.canbus.plan import MessageKey, MessagePlan, Quantity, Reader, VehicleDecoder
from tmde_edge.canbus.settings import CanSettings
from tmde_edge.canbus.yaw_offset import YawOffset
from tmde_edge.messages import CanFrame, EgoState

_TURN_HOLD_NS = 1_000_000_000  # lamps blink at 1 to 2 Hz: dark is not yet off
_PERIOD_UNLEARNED_NS = {"speed": 100_000_000, "yaw_rate": 100_000_000, "brake": 500_000_000, "turn_signal": 1_000_000_000}
_PERIOD_MAX_NS = {"speed": 1_000_000_000, "yaw_rate": 1_000_000_000, "brake": 2_000_000_000, "turn_signal": 10_000_000_000}
_OTHER_SENDER_NS = 1_000_000_000
_PERIOD_MIN_NS = 2_000_000
_GPS_TIMEOUT_NS = 3_000_000_000
_GPS_SIGMA_MPS = 0.3
_YAW_NOISE_RADPS = 0.003
_COMPLAIN_AFTER = 50  # frames
_RESYNC = 3  # this many implausible values that agree with each other are the truth after all


class Period:
    """Learns how often one quantity comes: on some pages of a multiplexed message that is less often than the message."""

    def __init__(self, unlearned_ns: int, max_ns: int) -> None:
        self.ns = float(unlearned_ns)
        self._max_ns = max_ns
        self._seen = 0
        self._last_ns: int | None = None

    def learn(self, t_ns: int) -> None:
        """The arrival of a good frame that carries the quantity; a step back in time is a new beginning."""
        last_ns, self._last_ns = self._last_ns, t_ns
        if last_ns is None or t_ns <= last_ns:
            return
        gap = float(min(max(t_ns - last_ns, _PERIOD_MIN_NS), self._max_ns))
        self._seen += 1
        if self._seen <= 10:  # plain mean at first
            self.ns = gap if self._seen == 1 else self.ns + (gap - self.ns) / self._seen
        else:  # then slowly, and a dropout does not stretch it
            self.ns += (min(gap, 3 * self.ns) - self.ns) / 20


class Channel:
    """One number with its age, its range and its greatest plausible rate of change."""

    def __init__(self, low: float, high: float, rate: float, margin: float) -> None:
        self.value: float | None = None
        self.t_ns = 0
        self._low, self._high, self._rate, self._margin = low, high, rate, margin
        self._doubt: tuple[int, float] | None = None
        self._doubts = 0

    def offer(self, t_ns: int, value: float, timeout_ns: float) -> bool:
        """Takes the value where it is plausible; an implausible one updates nothing."""
        if not math.isfinite(value) or not self._low <= value <= self._high:
            return False
        fresh = self.value is not None and abs(t_ns - self.t_ns) <= timeout_ns
        if fresh and self.value is not None and not self._near(t_ns, value, self.t_ns, self.value):
            agrees = self._doubt is not None and self._near(t_ns, value, *self._doubt)
            self._doubts = self._doubts + 1 if agrees else 1
            self._doubt = (t_ns, value)
            if self._doubts < _RESYNC:
                return False
        self._doubt, self._doubts = None, 0
        self.value, self.t_ns = value, t_ns
        return True

    def _near(self, t_ns: int, value: float, then_ns: int, then: float) -> bool:
        return abs(value - then) <= self._rate * abs(t_ns - then_ns) * 1e-9 + self._margin


@dataclass(slots=True)
class _Message:
    """What is remembered of one message."""

    can_id: int  # of J1939: the first sender of the PGN
    counter: CounterState | None
    period: dict[Quantity, Period]
    last_ns: int | None = None
    good: int = 0
    bad: int = 0  # checksum or counter wrong


class EgoReceiver:
    """Follows the own vehicle. `counts` tells how many frames were used and why others were not."""

    def __init__(self, decoder: VehicleDecoder, settings: CanSettings) -> None:
        vehicle = settings.vehicle
        self._decoder = decoder
        self._vehicle = vehicle
        self._periods = settings.timeout_periods
        self._messages: dict[MessageKey, _Message] = {}
        self._channel: str | None = vehicle.channel or None
        self._resolution_radps = 0.0
        self._speed = Channel(-30.0, vehicle.speed_max_mps, vehicle.accel_max_mps2, 1.0)
        self._yaw = Channel(-vehicle.yaw_rate_max_radps, vehicle.yaw_rate_max_radps, vehicle.yaw_accel_max_radps2, 0.1)
        self._gps = Channel(0.0, vehicle.speed_max_mps, vehicle.accel_max_mps2, 2.0)
        self._timeout_ns: dict[Quantity, float] = {
            "speed": self._periods * _PERIOD_UNLEARNED_NS["speed"],
            "yaw_rate": self._periods * _PERIOD_UNLEARNED_NS["yaw_rate"],
        }
        self._brake: tuple[int, float, bool] | None = None  # t_ns, timeout_ns, pressed
        self._turn: tuple[int, float, Literal["left", "right", "none"]] | None = None
        self._lit: tuple[int, Literal["left", "right"]] | None = None
        self._first_ns: int | None = None
        self.yaw_offset = YawOffset()
        self.counts: Counter[str] = Counter()

    @property
    def configured(self) -> bool:
        """True where a speed is expected at all."""
        return "speed" in self._decoder.quantities or self._decoder.gps

    @property
    def complaints(self) -> tuple[str, ...]:
        """For the user: messages that fail their checks nearly always, which is a wrong description rather than a bad bus."""
        return tuple(
            f"{message.bad} of {message.bad + message.good} frames of message {self._decoder.plans[key].name} fail its "
            f'{self._decoder.plans[key].rule or "counter"} check; if this vehicle has none, '
            'set checksum = "none" and no counter on its signals'
            for key, message in self._messages.items()
            if message.bad >= _COMPLAIN_AFTER and message.bad > 9 * message.good
        )

    def update(self, frame: CanFrame) -> EgoState | None:
        """Takes one frame; the new state where it brought a good value of a wanted signal, else None."""
        if self._first_ns is None:
            self._first_ns = frame.t_ns
        if frame.channel == gps.GPS_CHANNEL:
            return self._update_gps(frame)
        plan = self._decoder.find(frame.can_id, frame.extended)
        if plan is None or (self._channel not in (None, "*") and frame.channel != self._channel and not self._let_go(frame)):
            return None
        message = self._messages.get(plan.key)
        if message is None:
            message = self._messages[plan.key] = _Message(
                frame.can_id,
                CounterState(plan.counter) if plan.counter else None,
                {r.quantity: Period(_PERIOD_UNLEARNED_NS[r.quantity], _PERIOD_MAX_NS[r.quantity]) for r in plan.readers},
            )
        if frame.can_id != message.can_id:
            if message.last_ns is not None and abs(frame.t_ns - message.last_ns) < _OTHER_SENDER_NS:
                return None
            message.can_id = frame.can_id
        if not self._accept(plan, message, frame):
            return None
        used = False
        for reader in plan.readers:
            if reader.multiplex is None or reader.multiplex(frame.data):
                used |= self._read(reader, message, frame)
        message.last_ns = frame.t_ns
        if not used:
            return None
        self.counts["used"] += 1
        return self.state(frame.t_ns)

    def state(self, t_ns: int) -> EgoState | None:
        """The state known at t_ns, with the time of its speed; None while no fresh speed is known."""
        v = self._vehicle
        if self._fresh(self._speed, "speed", t_ns):
            source, sigma = self._speed, v.speed_sigma_mps
        elif self._gps.value is not None and abs(t_ns - self._gps.t_ns) <= _GPS_TIMEOUT_NS:
            source, sigma = self._gps, max(v.speed_sigma_mps, _GPS_SIGMA_MPS)
        else:
            return None
        speed = source.value
        if speed is None:
            return None
        yaw = yaw_sigma = None
        if self._fresh(self._yaw, "yaw_rate", t_ns) and self._yaw.value is not None:
            yaw, yaw_sigma = self._yaw.value, math.hypot(_YAW_NOISE_RADPS, self._resolution_radps / math.sqrt(12))
            if v.yaw_offset:
                yaw -= self.yaw_offset.offset_radps
                yaw_sigma = math.hypot(yaw_sigma, self.yaw_offset.sigma_radps)
        brake = self._brake[2] if self._brake is not None and abs(t_ns - self._brake[0]) <= self._brake[1] else None
        return EgoState(
            t_ns=source.t_ns,
            speed_mps=speed,
            yaw_rate_radps=yaw,
            speed_sigma_mps=sigma,
            yaw_rate_sigma_radps=yaw_sigma if yaw_sigma is not None else 0.01,
            brake_pressed=brake,
            turn_signal=self._turn_at(t_ns),
        )

    def lost(self, t_ns: int) -> bool:
        """True where a speed is configured but none is fresh at t_ns; the first second is the benefit of the doubt."""
        if not self.configured:
            return False
        if self._first_ns is None or t_ns < self._first_ns:
            self._first_ns = t_ns
        return self.state(t_ns) is None and t_ns - self._first_ns > self._periods * _PERIOD_UNLEARNED_NS["speed"]

    def observe_lane_yaw(self, t_ns: int, yaw_rate_radps: float, sigma_radps: float) -> None:
        """A yaw rate (positive left) known from the lane: teaches the zero offset."""
        self.yaw_offset.observe_lane_yaw(t_ns, yaw_rate_radps, sigma_radps)

    def _accept(self, plan: MessagePlan, message: _Message, frame: CanFrame) -> bool:
        """Length, order in time, checksum, counter."""
        if len(frame.data) < plan.min_bytes:
            self.counts["short"] += 1
            return False
        if plan.rule and not RULES[plan.rule](frame.can_id, frame.data):
            self.counts["bad_checksum"] += 1
            message.bad += 1
            return False
        if message.last_ns is not None and 0 < message.last_ns - frame.t_ns < 1_000_000_000:
            self.counts["out_of_order"] += 1  # further back is a clock that was set: begin again from there
            return False
        if message.counter is not None and not message.counter.accept(frame.data):
            self.counts["bad_counter"] += 1
            message.bad += 1
            return False
        message.good += 1
        return True

    def _read(self, reader: Reader, message: _Message, frame: CanFrame) -> bool:
        t_ns, data, quantity = frame.t_ns, frame.data, reader.quantity
        period = message.period[quantity]
        period.learn(t_ns)
        timeout_ns = self._periods * period.ns
        if quantity == "brake":
            pressed = reader.pressed(data)
            if pressed is not None:
                self._brake = (t_ns, timeout_ns, pressed)
            return pressed is not None
        if quantity == "turn_signal":
            turn = reader.turn(data)
            if turn is not None:
                self._turn = (t_ns, timeout_ns, turn)
                if turn != "none":
                    self._lit = (t_ns, turn)
            return turn is not None
        value = reader.number(data)
        if value is None:
            self.counts["not_available"] += 1
            return False
        target = self._speed if quantity == "speed" else self._yaw
        if not target.offer(t_ns, value, self._timeout_ns[quantity]):
            self.counts["implausible"] += 1
            return False
        self._timeout_ns[quantity] = timeout_ns
        if quantity == "speed":
            if self._channel is None:
                self._channel = frame.channel
        else:
            self._resolution_radps = reader.resolution
            if self._fresh(self._speed, "speed", t_ns) and self._speed.value is not None:
                self.yaw_offset.observe(t_ns, value, self._speed.value)
        return True

    def _let_go(self, frame: CanFrame) -> bool:
        """Another bus may serve once the first one has been silent (only where no channel is configured)."""
        if self._vehicle.channel or self._fresh(self._speed, "speed", frame.t_ns):
            return False
        self._channel = None
        self._messages.clear()
        return True

    def _fresh(self, channel: Channel, quantity: Quantity, t_ns: int) -> bool:
        return channel.value is not None and abs(t_ns - channel.t_ns) <= self._timeout_ns[quantity]

    def _turn_at(self, t_ns: int) -> Literal["left", "right", "none"] | None:
        if self._turn is None or abs(t_ns - self._turn[0]) > self._turn[1]:
            return None
        if self._turn[2] == "none" and self._lit is not None and 0 <= t_ns - self._lit[0] <= _TURN_HOLD_NS:
            return self._lit[1]
        return self._turn[2]

    def _update_gps(self, frame: CanFrame) -> EgoState | None:
        speed = gps.speed_from_frame(frame)
        if speed is None or not self._decoder.gps or not self._gps.offer(frame.t_ns, speed, _GPS_TIMEOUT_NS):
            self.counts["gps_unused"] += 1
            return None
        self.counts["used"] += 1
        return self.state(frame.t_ns)
