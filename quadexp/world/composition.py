"""An airframe's equations and effects, joined into the one function of a control period.

Over an integration step h, with the wind w, thrusts T, force F (world) and torque tau (body) held:

    v -= w        the airframe flies in the frame that moves with the air; exact, whatever the airframe
    v += h F / 2m,  omega += h J^-1 tau / 2        half of the external impulse before the step, half after it
    x  = step(x, T)
    v += h F / 2m,  omega += h J^-1 tau / 2
    v += w,  p += h w

The accelerometer's specific force gets R^T F / m besides. m is the mass that the airframe flies with, payload included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from quadexp.compile.symbolic import ca
from quadexp.names import named
from quadexp.physics.expression import split, symbols
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.world.asked import asked, measured_by
from quadexp.world.effect import Clock, Effect, Layout, Measured, Moment, Readings
from quadexp.world.integrator import INPUTS, OUTPUTS, Equations, period
from quadexp.world.repetition import repeated, trimmed

WORLD_INPUTS = (*INPUTS, "draws", "time")
WORLD_OUTPUTS = (*OUTPUTS, "measured")
KINDS = ("inner", "parameters", "draws")  # of an effect's numbers
IN_STEP = ("t", "x", "inner", "parameters", "step", "wind", "thrusts")  # what effects see of a step
WIND = 3  # inner states at the end: the wind of the last step, world (m/s)


def compose(
    equations: Equations,
    effects: Sequence[Effect],
    layout: Layout,
    clock: Clock,
    vehicle: Vehicle,
    columns: Mapping[str, int],
) -> ca.Function:
    """WORLD_INPUTS -> WORLD_OUTPUTS over a control period; then what the airframe keeps of the steps.

    columns: which inner states are columns of a flight, see World.columns.
    """
    last = 0
    for i, effect in enumerate(effects):
        if effect.steps():
            last = i + 1
    stepping = Layout(layout.airframe, layout.effects[:last])  # the rest only measures, once a period
    parts = _Parts(equations, tuple(effects[:last]), stepping, vehicle)
    airframe = layout.airframe
    steps = clock.steps
    n = vehicle.n_rotors
    x, inner, u, step, noise, parameters, draws, time = symbols(
        ca.MX,
        x=N_STATE,
        inner=layout.size("inner") + WIND,
        u=n,
        step=1,
        noise=(equations.step.size1_in(2), steps),
        parameters=layout.size("parameters"),
        draws=layout.size("draws"),
        time=1,
    )

    cut = [0, airframe.inner, stepping.size("inner"), layout.size("inner"), inner.numel()]
    inner_a, of_effects, measuring, _ = ca.vertsplit(inner, cut)
    theta = parameters[: airframe.parameters]
    known = parameters[: stepping.size("parameters")]
    begin = parts.inner_after("begin", "t", "x", "inner", "u", "parameters", "draws", "step")
    of_effects = begin(time, x, of_effects, u, known, draws[: stepping.size("draws")], step)
    rest = inner_a
    if equations.begin:
        wind, thrusts, *_ = parts.drive()(time, x, of_effects, u, known, step)
        s, _ = equations.begin(_seen_from_the_air(x, wind), inner_a, thrusts, theta)
        rest = s[N_STATE:]
    state = ca.vertcat(x, rest, parts.chosen(of_effects, parts.moving), ca.MX.zeros(WIND + n + 3))
    times = time + step * ca.DM(range(steps)).T
    single, used = trimmed(parts.step())
    still = parts.chosen(of_effects, parts.still)[used["still"]]
    states, *kept = repeated(single, steps, state, times, noise, (still, u, known[used["parameters"]], step))

    begun = of_effects
    last_t = time + clock.period
    x_next, of_effects, inner_a, wind, reading, doubt = parts.settled(states[:, -1], begun, known, theta, last_t, step)
    of_effects = ca.vertcat(of_effects, measuring)
    names = []
    forces_kept = None
    if equations.end:
        names = equations.step.name_out()[1:]
    else:
        forces_kept, *kept = kept
        reading = forces_kept[:, -1]
        doubt = ca.MX(1, 1)
    reading += states[-3:, -1]
    if not last and not any(effect.names_world for effect in effects):  # the airframe's own flight, to the last bit
        alone = period(equations, steps)(x, inner[: airframe.inner], u, noise, theta, step)
        x_next, inner_a, reading, doubt, *kept = alone
    everything = _Parts(equations, tuple(effects), layout, vehicle)
    doubt = everything.ended(of_effects, parameters, doubt)

    each_step = partial(parts.each_step, states, begun, known, theta, times, step)

    def columns_of(wanted: Sequence[str]) -> ca.MX:
        places = [columns[name] for name in wanted]
        first = ca.vertcat(inner[: airframe.inner], begun)[places]
        later = each_step(lambda x, of_effects, inner, *_: ca.vertcat(inner, of_effects)[places])
        return ca.horzcat(first, later)

    def forces() -> ca.MX:
        pushed = states[-3:, :]
        if not equations.end:
            return pushed + forces_kept
        return pushed + each_step(lambda *after: after[-2])

    measured = {"state": x_next, "specific_force": reading}
    known_now = (of_effects, parameters, draws, step, clock, vehicle)
    seen = Readings(last_t, ca.horzcat(x, states[:N_STATE, :]), *known_now, columns_of, forces)
    of_effects, measured = everything.measured(seen, measured)
    inner_next = ca.vertcat(inner_a, of_effects, wind)
    results = [x_next, inner_next, measured["specific_force"], doubt, measured["state"]]
    arguments = [x, inner, u, noise, parameters, step, draws, time]
    name = "_".join([equations.step.name(), *(effect.part for effect in effects)])
    return ca.Function(f"{name}_period", arguments, [*results, *kept], WORLD_INPUTS, [*WORLD_OUTPUTS, *names])


def wind_function(equations: Equations, effects: Sequence[Effect], layout: Layout, vehicle: Vehicle) -> ca.Function:
    """(t, x, the effects' inner states, u, parameters, step) -> the wind (3,), world (m/s), as in a step."""
    drive = _Parts(equations, tuple(effects), layout, vehicle).drive()
    return drive.slice("wind", range(drive.n_in()), [0])


def _seen_from_the_air(x: Any, wind: Any) -> Any:
    """A state in the frame that moves with the wind."""
    return ca.vertcat(x[: VELOCITY.start], x[VELOCITY] - wind, x[RATE])


class _Parts:
    """The functions that `compose` joins. Inner states: of all effects, one after another."""

    def __init__(self, equations: Equations, effects: tuple[Effect, ...], layout: Layout, vehicle: Vehicle) -> None:
        self._equations = equations
        self._effects = effects
        self._layout = layout
        self._vehicle = vehicle
        self._kind = ca.SX
        if any(effect.symbols == "MX" for effect in effects):
            self._kind = ca.MX
        # Effects whose inner states change from step to step, and those that only use them in the steps.
        self.moving = [i for i, effect in enumerate(effects) if effect.has("advance")]
        acting = [i for i, effect in enumerate(effects) if any(map(effect.has, ("wind", "thrusts", "wrench")))]
        self.still = [i for i in acting if i not in self.moving]

    def size(self, which: list[int]) -> int:
        """Number of the inner states of some effects."""
        return sum(self._layout.effects[i].inner for i in which)

    def chosen(self, of_effects: Any, which: list[int]) -> Any:
        """The inner states of some effects, of those of all."""
        pieces = self._cut(of_effects, "inner")
        return ca.vertcat(type(of_effects)(0, 1), *(pieces[i] for i in which))

    def assembled(self, moved: Any, of_effects: Any) -> Any:
        """The inner states of all effects: `moved` of those that change from step to step, the others' from
        `of_effects`."""
        pieces = self._cut(of_effects, "inner")
        self._place(pieces, self.moving, moved)
        return ca.vertcat(type(of_effects)(0, 1), *pieces)

    def _place(self, pieces: list[Any], which: list[int], values: Any) -> None:
        """Put the inner states of some effects, one after another, where those of each stand."""
        sizes = [self._layout.effects[i].inner for i in which]
        for i, piece in zip(which, split(values, sizes), strict=True):
            pieces[i] = piece

    def _cut(self, value: Any, kind: str) -> list[Any]:
        """The effects' shares of a vector, with the airframe's before them or, of the inner states, without."""
        first = 0
        if kind != "inner":
            first = getattr(self._layout.airframe, kind)
        pieces = []
        for sizes in self._layout.effects:
            end = first + getattr(sizes, kind)
            pieces.append(value[first:end])
            first = end
        return pieces

    def _symbols(self, *names: str) -> list[Any]:
        n = self._vehicle.n_rotors
        sizes = {"t": 1, "x": N_STATE, "u": n, "step": 1, "x_next": N_STATE, "wind": WIND, "thrusts": n}
        for kind in KINDS:
            sizes[kind] = self._layout.size(kind)
        sizes["inner"] -= self._layout.airframe.inner
        return [self._kind.sym(name, sizes[name]) for name in names]

    def _moments(self, **values: Any) -> list[Moment]:
        """What each effect sees. inner, parameters, draws: of all of them."""
        cut = []
        for kind in KINDS:
            pieces = [self._kind(0, 1)] * len(self._effects)
            if kind in values:
                pieces = self._cut(values[kind], kind)
            cut.append(pieces)
        values = {"wind": self._kind.zeros(WIND), "thrust": None, "x_next": None, "command": None} | values
        moments = []
        for its_own in zip(*cut, strict=True):
            moments.append(Moment(**values | named(KINDS, its_own)))
        return moments

    def _function(self, name: str, symbols: list[Any], results: list[Any]) -> ca.Function:
        results = [ca.densify(result) for result in results]
        if self._kind is ca.SX:
            results = ca.cse(results)
        return ca.Function(name, symbols, results)

    def inner_after(self, hook: str, *names: str) -> ca.Function:
        """(symbols of these names, with "thrusts" also those that enter each effect ..) -> inner states then."""
        symbols, moments = self._moments_of(names)
        inner = []
        for effect, at in zip(self._effects, moments, strict=True):
            after = at.inner
            if effect.has(hook):
                after = asked(effect, hook, at, sizes=(at.inner.numel(),))
            inner.append(after)
        return self._function(hook, symbols, [ca.vertcat(*inner)])

    def _moments_of(self, names: tuple[str, ...]) -> tuple[list[Any], list[Moment]]:
        """Symbols of these names, and what each effect sees of them."""
        symbols = self._symbols(*names)
        called = {"u": "command", "thrusts": "thrust"}
        words = [called.get(name, name) for name in names]
        moments = self._moments(**named(words, symbols))
        if "thrusts" not in names:
            return symbols, moments
        entering = [self._symbols("u")[0] for _ in self._effects]
        moments = [at._replace(command=command) for at, command in zip(moments, entering, strict=True)]
        return [*symbols, *entering], moments

    def drive(self) -> ca.Function:
        """(t, x, inner states, u, parameters, step) -> wind (3,), thrusts (n,), and those that enter each effect."""
        symbols = self._symbols("t", "x", "inner", "u", "parameters", "step")
        t, x, inner, command, parameters, step = symbols
        moments = self._moments(t=t, x=x, inner=inner, parameters=parameters, step=step)
        wind = self._kind.zeros(WIND)
        for effect, at in zip(self._effects, moments, strict=True):
            if effect.has("wind"):
                wind += asked(effect, "wind", at, sizes=(WIND,))
        entering = []
        for effect, at in zip(self._effects, moments, strict=True):
            entering.append(command)
            if effect.has("thrusts"):
                command = asked(effect, "thrusts", at._replace(command=command, wind=wind), sizes=(command.numel(),))
        return self._function("drive", symbols, [wind, command, *entering])

    def pushes(self) -> ca.Function:
        """(IN_STEP, thrusts that enter each effect ..) -> force (3,) world, torque (3,) body."""
        symbols, moments = self._moments_of(IN_STEP)
        force = self._kind.zeros(3)
        torque = self._kind.zeros(3)
        for effect, at in zip(self._effects, moments, strict=True):
            if effect.has("wrench"):
                more = asked(effect, "wrench", at, sizes=(3, 3))
                force = force + more[0]
                torque = torque + more[1]
        return self._function("pushes", symbols, [force, torque])

    def settled(self, S: Any, of_effects: Any, known: Any, theta: Any, t: Any, step: Any) -> tuple[Any, ...]:
        """State, inner states of effects and airframe, wind, specific force without effects' forces, and doubt, of a
        control period that would end after a step with S, see `step`. of_effects: as the period began."""
        equations = self._equations
        n = self._vehicle.n_rotors
        further = equations.step.size1_in(0) - N_STATE
        sizes = [N_STATE, further, self.size(self.moving), WIND, n, 3]
        x, rest, moved, wind, thrusts, _ = split(S, sizes)
        end = self.inner_after("end", "t", "x", "inner", "parameters", "step")
        of_effects = end(t, x, self.assembled(moved, of_effects), known, step)
        if not equations.end:
            return x, of_effects, rest, wind, None, None
        held = thrusts
        if equations.command:
            held = equations.command(thrusts, theta)
        _, inner, reading, doubt = equations.end(ca.vertcat(_seen_from_the_air(x, wind), rest), held, theta)
        return x, of_effects, inner, wind, reading, doubt

    def each_step(
        self, states: Any, inner_of_effects: Any, known: Any, theta: Any, times: Any, step: Any, select: Any
    ) -> ca.MX:
        """What `select` makes of `settled`, (k, steps). times: when the steps began."""
        arguments = [states[:, 0], inner_of_effects, known, theta, times[0], step]
        variables = [ca.MX.sym(f"s{i}", argument.numel()) for i, argument in enumerate(arguments)]
        S, inner, seen, settings, began, h = variables
        after = self.settled(S, inner, seen, settings, began + h, h)
        settled = ca.Function("settled", variables, [select(*after)])
        steps = states.size2()
        held = [ca.repmat(value, 1, steps) for value in (inner_of_effects, known, theta)]
        return settled.map(steps)(states, *held, times, ca.repmat(step, 1, steps))

    def step(self) -> ca.Function:
        """(S, t, still, u, noise, parameters, step) -> S, what the airframe keeps; S = [x, the airframe's further s,
        moving inner states, wind, thrusts, force over mass in the body frame (3,)]; still: those that stay."""
        equations = self._equations
        layout = self._layout
        n = self._vehicle.n_rotors
        further = equations.step.size1_in(0) - N_STATE
        moving = self.size(self.moving)
        sizes = [N_STATE, further, moving, WIND + n + 3]
        S, still = symbols(ca.MX, S=sum(sizes), still=self.size(self.still))
        x, rest, moved, _ = split(S, sizes)
        t, u, step, noise, parameters = symbols(
            ca.MX, t=1, u=n, step=1, noise=equations.step.size1_in(2), parameters=layout.size("parameters")
        )
        theta = parameters[: layout.airframe.parameters]

        pieces = [ca.MX(sizes.inner, 1) for sizes in layout.effects]
        self._place(pieces, self.still, still)
        of_effects = self.assembled(moved, ca.vertcat(ca.MX(0, 1), *pieces))
        wind, thrusts, *entering = self.drive()(t, x, of_effects, u, parameters, step)
        pushes = any(effect.has("wrench") for effect in self._effects)
        blows = any(effect.has("wind") for effect in self._effects)
        held = thrusts
        if equations.command:
            held = equations.command(thrusts, theta)
        delivered = thrusts
        if equations.thrust:
            delivered = equations.thrust(ca.vertcat(x, rest), held, theta, step)
        force, torque = self.pushes()(t, x, of_effects, parameters, step, wind, delivered, *entering)
        mass = self._vehicle.mass
        if equations.mass:
            mass = equations.mass(theta)
        kick = step / 2 * force / mass
        turn = step / 2 * (ca.inv(ca.DM(self._vehicle.inertia_matrix)) @ torque)

        def kicked(state: ca.MX) -> ca.MX:
            if not pushes:
                return state
            return ca.vertcat(state[: VELOCITY.start], state[VELOCITY] + kick, state[RATE] + turn)

        seen = x
        if blows:
            seen = _seen_from_the_air(x, wind)
        s, *kept = equations.step.call([ca.vertcat(kicked(seen), rest), held, noise, theta, step])
        x_next = kicked(s[:N_STATE])
        rest = s[N_STATE:]
        if blows:
            x_next = ca.vertcat(x_next[POSITION] + step * wind, x_next[ATTITUDE], x_next[VELOCITY] + wind, x_next[RATE])
        if self.moving:
            advance = self.inner_after("advance", *IN_STEP, "x_next")
            of_effects = advance(t, x, of_effects, parameters, step, wind, thrusts, x_next, *entering)
        pushed = ca.MX.zeros(3)
        if pushes:
            pushed = rotation_matrix(x_next[ATTITUDE]).T @ (force / mass)
        S_next = ca.vertcat(x_next, rest, self.chosen(of_effects, self.moving), wind, thrusts, pushed)
        function = ca.Function("world_step", [S, t, still, u, noise, parameters, step], [S_next, *kept])
        if self._kind is not ca.SX or not equations.step.is_a("SXFunction"):
            return function
        # In scalar expressions everything is one function, without copies, and what two hooks compute is computed once.
        arguments = function.sx_in()
        return ca.Function(function.name(), arguments, ca.cse(function.call(arguments)))

    def ended(self, of_effects: Any, parameters: Any, doubt: Any) -> Any:
        """The doubt of the airframe, or that an effect ends the flight: Python then says why."""
        inner_states = self._cut(of_effects, "inner")
        settings = self._cut(parameters, "parameters")
        for effect, inner, theta in zip(self._effects, inner_states, settings, strict=True):
            if effect.has("ended"):
                doubt = ca.fmax(doubt, asked(effect, "ended", inner, theta, sizes=(1,)))
        return doubt

    def measured(self, seen: Readings, measured: Measured) -> tuple[Any, Measured]:
        """The inner states of all effects after the period, and what the controller is given. seen: with those before,
        and all parameters and draws."""
        inner_states = []
        cut = [self._cut(getattr(seen, kind), kind) for kind in KINDS]
        for effect, inner, theta, drawn in zip(self._effects, *cut, strict=True):
            inner_now = inner
            if effect.has("measure"):
                inner_now, measured = measured_by(effect, seen, (inner, theta, drawn), measured)
            inner_states.append(inner_now)
        return ca.vertcat(*inner_states), measured
