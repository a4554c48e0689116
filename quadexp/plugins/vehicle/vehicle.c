/* Behind loop.c and the tables of a controller (controller.c): a flight begins, a step is made, without Python. What
   loop.c leaves to Python on the bench is here: readings that are no numbers, the first solution of the MPC, a reference
   that is far away, a step that has no answer. Freestanding C11: no allocation, of libraries only math.h.

   Declared before: ROTORS, ROWS, IMAGE, ROUND, SUMS, ram, sums, image, calls, the_loop, hover, thrust_min, thrust_max, start,
   command_now; without NO_PLAN the_plan, the_shift, the_period, NODES, SAMPLES, FULL_STEPS. */
#ifdef __FAST_MATH__
#error "compile this file without -ffast-math: what is not a number must be seen"
#endif

enum { OK, REFUSED, FAILED };
enum { FORCE, SPEED, READINGS };

static const real HELD = (real)0.1;        /* s, for which a reading may be missing; as readings.py */
static const real ADMITTED = (real)1e9;    /* length of what is measured, likewise */
static const real UNIT_ERROR = (real)0.5;  /* of a quaternion's squared length, likewise */
static const real ROUNDING = (real)1e-9;   /* s */

static integer instant, begun, good[READINGS], age[READINGS]; /* age: instants since the last good reading */
static real last[ROTORS];                                     /* command */

static int within(const real *values, integer count) {
    real squared = 0;
    for (integer i = 0; i < count; i++) {
        const real share = values[i] / ADMITTED;
        squared += share * share;
    }
    return squared < 1;
}

static int is_state(const real *x) {
    return x && within(x, BODY) && fabs(attitudes_product(x, x) - 1) < UNIT_ERROR;
}

static real clipped(real thrust) { return thrust < thrust_min ? thrust_min : thrust > thrust_max ? thrust_max : thrust; }

/* Whether a reading is measured now: 1, missing: 0, or neither there nor young enough: -1. As ReadingGate. */
static int reading(integer which, const real *values, integer count) {
    age[which]++;
    if (!values) return 0;
    if (within(values, count)) {
        good[which] = 1;
        age[which] = 0;
        return 1;
    }
    return good[which] && (real)age[which] * the_loop.period <= HELD + ROUNDING ? 0 : -1;
}

#ifndef NO_PLAN
static const real UNSOLVED = 3; /* Status.FAILED of active_set.py */
static const real CONVERGED = sizeof(real) == 8 ? (real)1e-6 : (real)1e-3; /* optimality residual; first_solve.py */
static integer cold;

/* Full steps without a shift, as ModelPredictiveController._converge before its line search. */
static int first_solution(mpc *p) {
    real kept[NODES];
    int made = 0;
    copy(kept, the_shift, NODES);
    for (integer i = 0; i < NODES; i++) the_shift[i] = 0;
    for (integer i = 0; i < FULL_STEPS; i++) {
        made = plan(p);
        if (!made || p->checks[2] < CONVERGED) break;
    }
    copy(the_shift, kept, NODES);
    cold = 0;
    return made;
}

/* As ModelPredictiveController.command: without an answer the last solution stays, and the instant goes on. */
static int planned(mpc *p) {
    if (cold ? first_solution(p) : plan(p)) return 1;
    if (isfinite(p->checks[0] + p->checks[1])) /* the bounded subproblem failed */
        for (integer i = 0; i < p->inputs * p->nodes; i++) p->guess[i] = 0;
    p->status = UNSOLVED;
    return 1;
}

/* As PredictiveController._within_reach. */
static int within_reach(const step_call *o, const mpc *p) {
    const real limit = o->factor * (1 + (real)1e-9), away = distance(o->source, o->other);
    if (!(away > limit)) return 1;
    real by[3];
    for (int i = 0; i < 3; i++) by[i] = (o->source[i] - o->other[i]) * (1 - limit / away);
    for (integer k = 0; k < p->reference_rows; k++)
        for (int i = 0; i < 3; i++) o->other[p->states * k + i] += by[i];
    return 1;
}

/* As PredictiveController.reset: the reference is the first guess. */
static void begin_plan(mpc *p, const real *state, const reference *r) {
    const real *rows = 0; /* of a window that is longer than the horizon: which of them make it */
    for (integer i = 0; i < the_loop.calls_size; i++)
        if (calls[i].kind == WINDOW && calls[i].count && (integer)calls[i].factor == p->reference_rows)
            rows = calls[i].source;
    copy(p->x0, state, BODY);
    for (integer k = 0; k < p->reference_rows; k++)
        copy(p->X_ref + p->states * k, r->states + BODY * (rows ? (integer)rows[k] : k), BODY);
    for (integer i = 0; i < the_loop.calls_size; i++)
        if (calls[i].kind == NEAR) (void)within_reach(calls + i, p);
    for (integer k = 0; k <= p->nodes; k++) copy(p->X + p->states * k, p->X_ref + p->states * SAMPLES * k, BODY);
    (void)to_side(p->X, p->nodes + 1, p->states, state);
    for (integer k = 0; k < p->nodes; k++)
        for (integer i = 0; i < p->inputs; i++)
            p->U[p->inputs * k + i] =
                clipped(r->inputs[p->inputs * (rows ? (integer)rows[SAMPLES * k] : SAMPLES * k) + i]);
    for (integer k = 0; k <= p->nodes; k++) /* rotors that lag: their thrusts are states */
        copy(p->X + p->states * k + BODY, p->U + p->inputs * (k < p->nodes ? k : k - 1), p->states - BODY);
    for (integer i = 0; i < p->inputs * p->nodes; i++) p->guess[i] = 0;
    p->status = 0;
    cold = 1;
}
#else
static int planned(mpc *p) { return (void)p, 0; }
static int within_reach(const step_call *o, const mpc *p) { return (void)o, (void)p, 0; }
#endif

static reference as_reference(const window *w) {
    static integer rows[ROWS];
    for (integer i = 0; i < ROWS; i++) rows[i] = i;
    const reference r = {&w->states[0][0], &w->inputs[0][0], &w->path[0][0], w->yaw, rows, 1, ROWS};
    return r;
}

/* OK, or REFUSED where the state or the reference is none: then no flight has begun. */
int QX(reset)(const real state[BODY], const window *w) {
    begun = 0;
    if (!w || !is_state(state)) return REFUSED;
    const reference r = as_reference(w);
    if (!of_numbers(&r, ROTORS)) return REFUSED;
    for (integer i = 0; i < ROTORS; i++) last[i] = clipped(ROWS > 1 ? r.inputs[i] : hover[i]);
    for (integer i = 0; i < RAM; i++) ram[i] = i < IMAGE ? image[i] : 0;
    for (integer i = 0; i < SUMS; i++) sums[i] = 0;
    start(state, last);
    for (integer i = 0; i < the_loop.calls_size; i++) {
        const step_call *o = calls + i;
        if (o->kind == COMMIT) copy(o->next, o->to, o->count);
    }
#ifndef NO_PLAN
    begin_plan(&the_plan, state, &r);
    for (integer i = 0; i < the_loop.calls_size; i++) {
        const step_call *o = calls + i;
        if (o->kind == COMMIT) copy(o->to, o->source, o->count);
    }
#endif
    for (integer i = 0; i < READINGS; i++) good[i] = age[i] = 0;
    instant = 0;
    begun = 1;
    return OK;
}

/* force, speed: null where they were not measured. REFUSED: nothing was changed. FAILED: no answer was found; a law's
   memory is as before, an MPC goes on with its last solution. The command is always one to send. */
int QX(step)(const real state[BODY], const real *force, const real *speed, const window *w, real command[ROTORS]) {
    int status = REFUSED;
    const loop *l = &the_loop;
    const int read = reading(FORCE, force, 3), turning = reading(SPEED, speed, ROTORS);
    if (begun && w && read >= 0 && turning >= 0 && is_state(state)) {
        const reference r = as_reference(w);
        if (of_numbers(&r, ROTORS)) {
            copy(l->state, state, BODY);
            if (read) copy(l->specific_force, force, 3);
            if (turning) copy(l->rotor_speed, speed, ROTORS);
            *l->accelerometer_valid = (real)read, *l->rotor_speed_valid = (real)turning;
            status = control(l, instant, &r, 0) ? OK : FAILED;
            instant = instant + 1 < ROUND ? instant + 1 : 0;
            if (status == OK) copy(last, command_now, ROTORS);
#ifndef NO_PLAN
            if (the_plan.status == UNSOLVED) status = FAILED;
#endif
        }
    }
    copy(command, last, ROTORS);
    return status;
}

/* Body rates of the first two nodes of an MPC's prediction (rad/s), and the time between these (s), for stacks that take
   rates; null of a law. */
const real *QX(rates)(void) {
#ifndef NO_PLAN
    static real predicted[7];
    copy(predicted, the_plan.X + BODY - 3, 3);
    copy(predicted + 3, the_plan.X + the_plan.states + BODY - 3, 3);
    predicted[6] = *the_period;
    return predicted;
#else
    return 0;
#endif
}

/* What may be changed between two steps, at the places that controller.h names; a reset leaves it. */
real *QX(numbers)(void) { return numbers; }
