/* Control periods of a flight, one after another, as the loop of rollout.py makes them: the operations of a control
   instant (quadexp/control/instant.py), among them the MPC's step, then the plant's period. Every number is the Python
   loop's own, and so is its place: the arrays are those that the functions have in Python, so that at any instant the
   one may take over from the other. What is out of the ordinary is left to Python, before anything has been changed, or
   after it was changed back: `fly` then returns where it is. compiled_flight.py has the same structures, field by field.
   Compiled without -ffast-math: what is not a number must be seen. */

#include <math.h>
#include <string.h>
#include <time.h>

enum { STATES = 13, ATTITUDE = 3, RECORD = 6, PATH = 15, YAW = 4 };
enum { CALL, COPY, MOVE, WINDOW, SQUARE, DIVIDE, MIX, ADD, FINITE, BELOW, NEAR, PLAN, PYTHON }; /* KINDS of instant.py */

static const double HUGE_NUMBER = 1e100; /* beyond which sums may not be finite */
static const double LARGEST = 1e8;       /* of a reading; readings.py decides about what is beyond */
static const double TURNED = 1e-9;       /* a product of quaternions nearer to zero may have either sign */
static const double LENGTH_ERROR = 0.4;  /* of a quaternion's squared length; likewise */

typedef long long integer;

typedef struct { /* a function that CasADi has generated, its arrays and its memory for work */
    int (*call)(const double **, double **, integer *, double *, int);
    const double **arguments;
    double **results;
    integer *iw;
    double *w;
} function;

typedef struct { /* see instant.py; kept: of a MOVE, what was there before */
    integer kind, every, count;
    double factor;
    double *to, *kept, *other;
    const double *source, *when;
    const function *function;
} operation;

typedef struct {
    function step, lean, bounded, plant; /* lean: the step without what only a bounded subproblem needs */
    integer samples, nodes, inputs, inner_size, logged_size, extra_size, noise_size, noise_argument, draws_argument,
        draws_at, doubt_size, operations_size;
    double near, tolerance, max_turn, period;
    const operation *operations;
    /* reference: its states and inputs, the rows of each horizon (samples, reference_rows); at the instants the states,
       path and yaw */
    const double *states, *thrusts, *along, *paths, *yaws;
    const integer *where;
    integer reference_rows, plan_rows; /* of a horizon, and of those the plan's: N + 1, or more, see MPCSettings */
    /* step: what it reads and leaves */
    double *x0, *X_ref, *X, *U;
    const double *checks, *X_new, *U_new, *X_lin, *U_lin;
    /* bounded subproblem */
    double *guess;
    const double *bounded_checks, *bounded_X, *bounded_U, *side;
    /* plant */
    double *plant_x, *plant_inner, *plant_u, *plant_time; /* plant_time, measured: null but in a world */
    const double *x_next, *inner_next, *specific_force, *doubt, *measured;
    const double *noise; /* of the periods first_drawn .. end_drawn - 1, each its noise and then its draws */
    integer first_drawn, end_drawn;
    /* now; command, held: what the operations leave; held: null with a plan */
    double *x, *told, *reading, *inner, *speed, *path, *yaw; /* all but x and inner as the controller is told */
    const integer *rotors;                      /* inner states that are rotor speeds; null where there are none */
    const double *command, *held;
    double time, next_change;
    integer met;       /* whether a bound was met in the last step: then the next is likely to meet one too */
    integer commanded; /* whether the control step of the instant has been made, and its period not yet flown */
    double status, sweeps, active, kkt, converged; /* of the last plan */
    /* log, a row a control instant */
    const integer *logged; /* which inner states */
    const double *const *extra;
    const integer *extra_sizes;
    integer extra_arrays;
    double *log_state, *log_input, *log_reading, *log_inner, *log_record, *log_estimate, *log_extra; /* may be null */
} flight;

static void copy(double *to, const double *from, integer count) {
    if (count) memmove(to, from, sizeof(double) * (size_t)count); /* of nothing, the pointers are null */
}

static int run(const function *f) { return f->call(f->arguments, f->results, f->iw, f->w, 0); }

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int ordinary(const double *values, integer count, double largest) {
    for (integer i = 0; i < count; i++)
        if (!(fabs(values[i]) < largest)) return 0;
    return 1;
}

static double distance(const double *x, const double *wanted) {
    double squared = 0;
    for (int i = 0; i < 3; i++) squared += (x[i] - wanted[i]) * (x[i] - wanted[i]);
    return sqrt(squared);
}

static double attitudes_product(const double *a, const double *b) {
    double product = 0;
    for (int i = ATTITUDE; i < ATTITUDE + 4; i++) product += a[i] * b[i];
    return product;
}

/* Turns the attitudes of `count` states to the side of x's; 0 where the side is in doubt. */
static int to_side(double *states, integer count, const double *x) {
    const double product = attitudes_product(states, x);
    if (!(fabs(product) > TURNED)) return 0;
    if (product < 0)
        for (integer k = 0; k < count; k++)
            for (int i = ATTITUDE; i < ATTITUDE + 4; i++) states[STATES * k + i] *= -1;
    return 1;
}

/* As ModelPredictiveController._move. */
static void towards(double *guess, const double *from, const double *to, integer count, double turn, double largest) {
    if (turn <= largest) {
        copy(guess, to, count);
        return;
    }
    double length = largest / turn;
    for (integer i = 0; i < count; i++) {
        double change = length * (to[i] - from[i]);
        guess[i] = from[i] + change;
    }
}

static int plan(flight *f) {
    const integer X_size = STATES * (f->nodes + 1), U_size = f->inputs * f->nodes;
    const double *X_new = f->X_new, *U_new = f->U_new;
    double status = 0, sweeps = 0, active = 0;
    if (!to_side(f->X_ref, f->plan_rows, f->x0) || !to_side(f->X, f->nodes + 1, f->x0)) return 0;
    if (run(f->met ? &f->step : &f->lean)) return 0;
    const int all = f->met || f->checks[0] > f->tolerance || f->checks[1] > f->max_turn;
    if (all && !f->met && run(&f->step)) return 0;
    const double excess = f->checks[0], kkt = f->checks[2];
    double turn = f->checks[1];
    if (!isfinite(excess + turn)) return 0;
    f->met = excess > f->tolerance;
    if (excess <= f->tolerance) {
        memset(f->guess, 0, sizeof(double) * (size_t)U_size);
    } else {
        if (run(&f->bounded)) return 0;
        const double *found = f->bounded_checks; /* solved, exchanges, active, error, turn */
        if (found[0] == 0 || !isfinite(found[3] + found[4])) return 0;
        status = 1, sweeps = found[1], active = found[2], turn = found[4];
        copy(f->guess, f->side, U_size);
        X_new = f->bounded_X, U_new = f->bounded_U;
    }
    towards(f->X, f->X_lin, X_new, X_size, turn, f->max_turn);
    towards(f->U, f->U_lin, U_new, U_size, turn, f->max_turn);
    f->status = status, f->sweeps = sweeps, f->active = active, f->kkt = kkt, f->converged = 1;
    return 1;
}

static void look_ahead(const flight *f, integer k, double *states, double *thrusts, integer size, const double *which) {
    const integer *rows = f->where + k * f->reference_rows, n = f->inputs, count = size / STATES;
    for (integer i = 0; i < count; i++) {
        const integer row = rows[which ? (integer)which[i] : i];
        copy(states + STATES * i, f->states + STATES * row, STATES);
        if (i < count - 1) copy(thrusts + n * i, f->thrusts + n * row, n);
    }
}

static int operate(flight *f, const operation *o, integer k) {
    const integer n = o->count;
    switch (o->kind) {
    case CALL: return !run(o->function);
    case MOVE: copy(o->kept, o->to, n); /* fall through */
    case COPY: copy(o->to, o->source, n); return 1;
    case WINDOW: look_ahead(f, k, o->to, o->other, n, o->source); return 1;
    case SQUARE: for (integer i = 0; i < n; i++) o->to[i] = o->factor * (o->source[i] * o->source[i]); return 1;
    case DIVIDE: for (integer i = 0; i < n; i++) o->to[i] = o->source[i] / o->other[0]; return 1;
    case ADD: for (integer i = 0; i < n; i++) o->to[i] = o->source[i] + o->other[i]; return 1;
    case MIX:
        for (integer i = 0; i < n; i++) o->to[i] = o->factor * o->source[i] + (1 - o->factor) * o->other[i];
        return 1;
    case FINITE: return ordinary(o->source, n, HUGE_NUMBER);
    case BELOW: return o->source[0] <= o->factor;
    case NEAR: return distance(o->source, o->other) <= o->factor;
    case PLAN: return plan(f);
    default: return 0;
    }
}

static int due(const operation *o, integer k) { return !(k % o->every) && (!o->when || *o->when != 0); }

static int control(flight *f, integer k) {
    const double *x = f->told, *wanted = f->along + STATES * k;
    if (!(distance(f->x, wanted) <= f->near)) return 0;
    if (!ordinary(f->x, STATES, LARGEST) || !ordinary(x, STATES, LARGEST) || !ordinary(f->reading, 3, LARGEST)) return 0;
    if (!(fabs(attitudes_product(x, x) - 1) < LENGTH_ERROR)) return 0;
    if (f->rotors && !ordinary(f->speed, f->inputs, LARGEST)) return 0;

    const double began = seconds();
    copy(f->path, f->paths + PATH * k, PATH);
    copy(f->yaw, f->yaws + YAW * k, YAW);
    for (integer i = 0; i < f->operations_size; i++) {
        if (!due(f->operations + i, k) || operate(f, f->operations + i, k)) continue;
        while (i-- > 0) {
            const operation *o = f->operations + i;
            if (o->kind == MOVE && due(o, k)) copy(o->to, o->kept, o->count);
        }
        return 0;
    }

    copy(f->log_state + STATES * k, f->x, STATES);
    if (f->log_estimate) copy(f->log_estimate + STATES * k, x, STATES);
    copy(f->log_input + f->inputs * k, f->command, f->inputs);
    copy(f->log_reading + 3 * k, f->reading, 3);
    for (integer i = 0; i < f->logged_size; i++) f->log_inner[f->logged_size * k + i] = f->inner[f->logged[i]];
    double *row = f->log_extra + f->extra_size * k;
    for (integer i = 0; i < f->extra_arrays; row += f->extra_sizes[i++]) copy(row, f->extra[i], f->extra_sizes[i]);
    const double active = f->held ? f->held[0] : f->active;
    const double record[RECORD] = {seconds() - began, f->status, f->sweeps, active, f->kkt, f->converged};
    copy(f->log_record + RECORD * k, record, RECORD);
    return 1;
}

static int advance(flight *f, integer k) {
    if (k < f->first_drawn || k >= f->end_drawn || f->next_change <= f->time + 1e-9) return 0;
    copy(f->plant_x, f->x, STATES);
    copy(f->plant_inner, f->inner, f->inner_size);
    copy(f->plant_u, f->log_input + f->inputs * k, f->inputs);
    f->plant.arguments[f->noise_argument] = f->noise + f->noise_size * (k - f->first_drawn);
    if (f->plant_time) {
        *f->plant_time = f->time;
        f->plant.arguments[f->draws_argument] = f->plant.arguments[f->noise_argument] + f->draws_at;
    }
    if (run(&f->plant) || !ordinary(f->x_next, STATES, HUGE_NUMBER)) return 0;
    for (integer i = 0; i < f->doubt_size; i++)
        if (f->doubt[i] != 0) return 0;
    copy(f->x, f->x_next, STATES);
    copy(f->told, f->measured ? f->measured : f->x, STATES);
    copy(f->inner, f->inner_next, f->inner_size);
    copy(f->reading, f->specific_force, 3);
    if (f->rotors)
        for (integer i = 0; i < f->inputs; i++) f->speed[i] = f->inner[f->rotors[i]];
    f->time += f->period;
    return 1;
}

/* Flies from control instant k on; returns the instant at which Python is needed, or `samples`. */
integer fly(flight *f, integer k) {
    for (;; k++) {
        if (!f->commanded && (k >= f->samples || !control(f, k))) return k;
        f->commanded = 1;
        if (!advance(f, k)) return k;
        f->commanded = 0;
    }
}
