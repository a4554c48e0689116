/* A control instant: the calls of control_step.py, among them the MPC's step, on the arrays that they have in Python,
   so that at any instant the one may take over from the other. Every number is Python's own. What is out of the
   ordinary is left to Python, before anything has been changed, or after it was changed back: a function then returns
   0. Freestanding C11: no allocation, of libraries only math.h; the caller has the clock. compiled_loop.py reads the
   structures. Compiled without -ffast-math: what is not a number must be seen.

   With ALONE defined there is no Python behind it (plugins/vehicle): `planned` and `within_reach`, of the text that
   stands behind this one, do what is out of the ordinary. NO_PLAN: of a law in closed form. */

#include <math.h>

#ifndef REAL
#define REAL double /* of the functions that are called too */
#endif
#ifndef INTEGER
#define INTEGER long long /* likewise */
#endif
#ifndef SUM
#define SUM REAL /* of what a GATHER sums up over a flight */
#endif

enum { BODY = 13, ATTITUDE = 3, PATH = 15, YAW = 4 };
/* KINDS of control_step.py */
enum { CALL, COPY, COMMIT, WINDOW, SQUARE, DIVIDE, MIX, ADD, GATHER, FINITE, NEAR, PLAN, PYTHON };

typedef REAL real;
typedef SUM sum;
typedef INTEGER integer;

static const real HUGE_NUMBER = (real)1e30; /* beyond which sums may not be finite */
static const real LARGEST = (real)1e8;      /* of a reading; readings.py decides about what is beyond */
static const real TURNED = (real)1e-9;      /* a product of quaternions nearer to zero may have either sign */
static const real LENGTH_ERROR = (real)0.4; /* of a quaternion's squared length; likewise */

typedef struct { /* a function that CasADi has generated, its arrays and its memory for work */
    int (*call)(const real **, real **, integer *, real *, int);
    const real **arguments;
    real **results;
    integer *iw;
    real *w;
} function;

typedef struct { /* see control_step.py; next: of a COMMIT, its source; count: of a WINDOW, length of to's rows, factor: how
   many, where source says which; rows, columns: of a GATHER's block, whose `to` are sums */
    integer kind, every, count, rows, columns;
    real factor;
    real *to, *next, *other;
    const real *source, *when;
    const function *function;
} step_call;

typedef struct { /* the MPC's step, with the arrays that it reads and leaves */
    function prepare, feedback, bounded;
    integer states, inputs, nodes, reference_rows;
    real tolerance, max_turn;
    real *x0, *X_ref, *X, *U, *guess, *unprepared; /* unprepared: whether all is to be done, 1 or 0 */
    const real *checks, *X_new, *U_new, *X_lin, *U_lin, *bounded_checks, *bounded_X, *bounded_U, *side;
    real status, sweeps, active, kkt, converged; /* of the last step */
} mpc;

typedef struct { /* at some instants: path, heading, and which rows of the states and inputs make the horizon */
    const real *states, *inputs, *paths, *yaws;
    const integer *where;
    integer instants, rows; /* rows of a horizon: N + 1, or more where it is sampled within the nodes too */
} reference;

typedef struct { /* for which instant a step has been prepared, -1: for none; steps before it in this flight; then
                    whether there is a window, a reading of the accelerometer, one of the rotors */
    real t, prepared, k, referred, accelerometer_valid, rotor_speed_valid, state[BODY], specific_force[3], rotor_speed[];
} measured;

typedef struct {
    const step_call *calls;
    integer calls_size, inputs;
    mpc *plan; /* null: of a law in closed form */
    real *state, *specific_force, *rotor_speed, *path, *yaw; /* what the controller is given, see InputArrays */
    real *accelerometer_valid, *rotor_speed_valid; /* whether force and rotor_speed are measured now */
    /* of `step` alone */
    const measured *given;
    const reference *reference, *window;
    real period;
} loop;

static void copy(real *to, const real *from, integer count) {
    if (count) __builtin_memmove(to, from, sizeof(real) * (unsigned long)count);
}

static int run(const function *f) { return f->call(f->arguments, f->results, f->iw, f->w, 0); }

static int ordinary(const real *values, integer count, real largest) {
    for (integer i = 0; i < count; i++)
        if (!(fabs(values[i]) < largest)) return 0;
    return 1;
}

static real distance(const real *x, const real *wanted) {
    real squared = 0;
    for (int i = 0; i < 3; i++) squared += (x[i] - wanted[i]) * (x[i] - wanted[i]);
    return sqrt(squared);
}

static real attitudes_product(const real *a, const real *b) {
    real product = 0;
    for (int i = ATTITUDE; i < ATTITUDE + 4; i++) product += a[i] * b[i];
    return product;
}

#ifndef NO_PLAN
/* Turns the attitudes of `count` states to the side of x's; 0 where the side is in doubt. */
static int to_side(real *states, integer count, integer width, const real *x) {
    const real product = attitudes_product(states, x);
#ifndef ALONE
    if (!(fabs(product) > TURNED)) return 0;
#endif
    if (product < 0)
        for (integer k = 0; k < count; k++)
            for (int i = ATTITUDE; i < ATTITUDE + 4; i++) states[width * k + i] *= -1;
    return 1;
}

/* As ModelPredictiveController._move. */
static void towards(real *guess, const real *from, const real *to, integer count, real turn, real largest) {
    if (turn <= largest) {
        copy(guess, to, count);
        return;
    }
    real length = largest / turn;
    for (integer i = 0; i < count; i++) {
        real change = length * (to[i] - from[i]);
        guess[i] = from[i] + change;
    }
}

/* The solution without bounds, as ModelPredictiveController.command and .feedback begin. */
static int unbounded(const mpc *p) {
    if (*p->unprepared != 0) {
        if (!to_side(p->X_ref, p->reference_rows, p->states, p->x0)) return 0;
        if (!to_side(p->X, p->nodes + 1, p->states, p->x0) || run(&p->prepare)) return 0;
    } else if (!to_side(p->x0, 1, p->states, p->X) || !(attitudes_product(p->X_ref, p->x0) > TURNED)) {
        return 0;
    }
    return !run(&p->feedback);
}

static int plan(mpc *p) {
    const integer X_size = p->states * (p->nodes + 1), U_size = p->inputs * p->nodes;
    const real *X_new = p->X_new, *U_new = p->U_new;
    real status = 0, sweeps = 0, active = 0;
    if (!unbounded(p)) return 0;
    const real excess = p->checks[0], kkt = p->checks[2];
    real turn = p->checks[1];
    if (!isfinite(excess + turn)) return 0;
    if (excess <= p->tolerance) {
        for (integer i = 0; i < U_size; i++) p->guess[i] = 0;
    } else {
        if (run(&p->bounded)) return 0;
        const real *found = p->bounded_checks; /* solved, exchanges, active, error, turn */
        if (found[0] == 0 || !isfinite(found[3] + found[4])) return 0;
        status = 1, sweeps = found[1], active = found[2], turn = found[4];
        copy(p->guess, p->side, U_size);
        X_new = p->bounded_X, U_new = p->bounded_U;
    }
    towards(p->X, p->X_lin, X_new, X_size, turn, p->max_turn);
    towards(p->U, p->U_lin, U_new, U_size, turn, p->max_turn);
    p->status = status, p->sweeps = sweeps, p->active = active, p->kkt = kkt, p->converged = 1;
    return 1;
}

#endif

static void look_ahead(const reference *r, integer at, const step_call *o, integer n) {
    const integer *rows = r->where + at * r->rows, count = o->source ? (integer)o->factor : r->rows;
    for (integer i = 0; i < count; i++) {
        const integer row = rows[o->source ? (integer)o->source[i] : i];
        copy(o->to + o->count * i, r->states + BODY * row, BODY);
        if (i < count - 1) copy(o->other + n * i, r->inputs + n * row, n);
    }
}

/* Every number is summed up in the order of the rows; rows: known where it is compiled, so that it stays in registers. */
static inline __attribute__((always_inline)) void add_products(const step_call *o, const integer rows) {
    const integer n = o->columns;
    const sum factor = o->factor;
    sum *restrict to = (void *)o->to;
    const sum *last = to + o->count;
    for (const real *restrict source = o->source; to < last; source += rows * n)
        for (integer i = 0; i < n; i++, to += n)
            for (integer j = 0; j <= i; j++) {
                sum all = factor * to[j];
                for (integer k = 0; k < rows; k++) all += (sum)source[k * n + i] * (sum)source[k * n + j];
                to[j] = all;
            }
}

static void gather(const step_call *o) {
    switch (o->rows) {
    case 1: add_products(o, 1); return;
    case 2: add_products(o, 2); return;
    case 3: add_products(o, 3); return;
    default: add_products(o, o->rows);
    }
}

#ifdef ALONE
static int planned(mpc *p);
static int within_reach(const step_call *o, const mpc *p);
#else
static int planned(mpc *p) { return plan(p); }
static int within_reach(const step_call *o, const mpc *p) { return (void)o, (void)p, 0; }
#endif

static int operate(const loop *l, const step_call *o, const reference *r, integer at) {
    const integer n = o->count;
    switch (o->kind) {
    case CALL: return !run(o->function);
    case COPY:
    case COMMIT: copy(o->to, o->source, n); return 1;
    case WINDOW: look_ahead(r, at, o, l->inputs); return 1;
    case SQUARE: for (integer i = 0; i < n; i++) o->to[i] = o->factor * (o->source[i] * o->source[i]); return 1;
    case DIVIDE: for (integer i = 0; i < n; i++) o->to[i] = o->source[i] / o->other[0]; return 1;
    case ADD: for (integer i = 0; i < n; i++) o->to[i] = o->source[i] + o->other[i]; return 1;
    case MIX:
        for (integer i = 0; i < n; i++) o->to[i] = o->factor * o->source[i] + (1 - o->factor) * o->other[i];
        return 1;
    case GATHER: gather(o); return 1;
    case FINITE: return ordinary(o->source, n, HUGE_NUMBER);
    case NEAR: return distance(o->source, o->other) <= o->factor || within_reach(o, l->plan);
    case PLAN: return planned(l->plan);
    default: return 0;
    }
}

static int due(const step_call *o, integer k) { return !(k % o->every) && (!o->when || *o->when != 0); }

#ifndef ALONE
/* Whether readings.py would admit what is measured; specific_force, rotor_speed: may be null. */
static int admitted(const loop *l, const real *x, const real *specific_force, const real *rotor_speed) {
    if (!ordinary(x, BODY, LARGEST) || !(fabs(attitudes_product(x, x) - 1) < LENGTH_ERROR)) return 0;
    return (!specific_force || ordinary(specific_force, 3, LARGEST)) && (!rotor_speed || ordinary(rotor_speed, l->inputs, LARGEST));
}
#endif

/* Control instant k of a flight, at the instant `at` of a reference, for what the controller has been given. */
static int control(const loop *l, integer k, const reference *r, integer at) {
    copy(l->path, r->paths + PATH * at, PATH);
    copy(l->yaw, r->yaws + YAW * at, YAW);
    for (integer i = 0; i < l->calls_size; i++) {
        if (!due(l->calls + i, k) || operate(l, l->calls + i, r, at)) continue;
        for (i = 0; i < l->calls_size; i++) {
            const step_call *o = l->calls + i;
            if (o->kind == COMMIT) copy(o->next, o->to, o->count);
        }
        return 0;
    }
    return 1;
}

static int of_numbers(const reference *r, integer inputs) {
    return ordinary(r->states, BODY * r->rows, LARGEST) && ordinary(r->inputs, inputs * (r->rows - 1), LARGEST) &&
           ordinary(r->paths, PATH, LARGEST) && ordinary(r->yaws, YAW, LARGEST);
}

#ifndef ALONE
/* A step of a loop of the user's own, who may have given a reference for it. */
int step(loop *l) {
    const measured *m = l->given;
    const reference *r = m->referred ? l->window : l->reference;
    if (!(fabs(m->t) < LARGEST)) return 0;
    real at = rint(m->t / l->period);
    at = at < 0 ? 0 : at < l->reference->instants - 1 ? at : l->reference->instants - 1;
    if ((m->prepared >= 0 && m->prepared != at) || (m->referred && !of_numbers(r, l->inputs))) return 0;
    if (!admitted(l, m->state, m->accelerometer_valid ? m->specific_force : 0, m->rotor_speed_valid ? m->rotor_speed : 0)) return 0;
    copy(l->state, m->state, BODY);
    if (m->accelerometer_valid) copy(l->specific_force, m->specific_force, 3);
    if (m->rotor_speed_valid) copy(l->rotor_speed, m->rotor_speed, l->inputs);
    *l->accelerometer_valid = m->accelerometer_valid, *l->rotor_speed_valid = m->rotor_speed_valid;
    if (l->plan) *l->plan->unprepared = m->prepared < 0;
    const int made = control(l, (integer)m->k, r, m->referred ? 0 : (integer)at);
    if (l->plan) *l->plan->unprepared = 1;
    return made;
}
#endif
