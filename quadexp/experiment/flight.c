/* Control periods of a flight, one after another, as the loop of rollout.py makes them: ModelPredictiveController's step
   on the reference, then the plant's period. Every number is the loop's own, and so is its place: the arrays are those
   that the functions have in Python, so that at any instant the one may take over from the other. What is out of the
   ordinary is left to Python, before anything has been changed: `fly` then returns where it is. compiled_flight.py has
   the same structures, field by field. Compiled without -ffast-math: what is not a number must be seen. */

#include <math.h>
#include <string.h>
#include <time.h>

enum { STATES = 13, ATTITUDE = 3, RECORD = 6 };

static const double HUGE_NUMBER = 1e100; /* beyond which sums may not be finite */
static const double TURNED = 1e-9;       /* a product of quaternions nearer to zero may have either sign */

typedef long long integer;

typedef struct { /* a function that CasADi has generated, its arrays and its memory for work */
    int (*call)(const double **, double **, integer *, double *, int);
    const double **arguments;
    double **results;
    integer *iw;
    double *w;
} function;

typedef struct {
    function step, lean, bounded, plant; /* lean: the step without what only a bounded subproblem needs */
    integer samples, nodes, inputs, inner_size, logged_size, noise_size, noise_argument, draws_argument, draws_at,
        doubt_size;
    double near, reach, tolerance, max_turn, period;
    /* reference: its states and inputs, the rows of each horizon (samples, reference_rows), the states at control instants */
    const double *states, *thrusts, *along;
    const integer *where;
    integer reference_rows; /* of a horizon: N + 1, or more where the reference is sampled within the nodes too */
    /* step: what it reads and leaves */
    double *x0, *X_ref, *U_ref, *X, *U;
    const double *checks, *X_new, *U_new, *X_lin, *U_lin;
    /* bounded subproblem */
    double *guess;
    const double *bounded_checks, *bounded_X, *bounded_U, *side;
    /* plant */
    double *plant_x, *plant_inner, *plant_u, *plant_time; /* plant_time, measured: null but in a world */
    const double *x_next, *inner_next, *specific_force, *doubt, *measured;
    const double *noise; /* of the periods first_drawn .. end_drawn - 1, each its noise and then its draws */
    integer first_drawn, end_drawn;
    /* now */
    double *x, *told, *reading, *inner; /* told: the state as the controller has it; x itself but in a world */
    double time, next_change;
    integer met;       /* whether a bound was met in the last step: then the next is likely to meet one too */
    integer commanded; /* whether the control step of the instant has been made, and its period not yet flown */
    /* log, a row a control instant */
    const integer *logged; /* which inner states */
    double *log_state, *log_input, *log_reading, *log_inner, *log_record, *log_estimate; /* log_estimate: may be null */
} flight;

static void copy(double *to, const double *from, integer count) {
    if (count) memcpy(to, from, sizeof(double) * (size_t)count); /* of nothing, the pointers are null */
}

static int run(const function *f) { return f->call(f->arguments, f->results, f->iw, f->w, 0); }

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int ordinary(const double *values, integer count) {
    for (integer i = 0; i < count; i++)
        if (!(fabs(values[i]) < HUGE_NUMBER)) return 0;
    return 1;
}

static double distance(const double *x, const double *wanted) {
    double squared = 0;
    for (int i = 0; i < 3; i++) squared += (x[i] - wanted[i]) * (x[i] - wanted[i]);
    return sqrt(squared);
}

/* Turns the attitudes of `count` states to the side of x's; 0 where the side is in doubt. */
static int to_side(double *states, integer count, const double *x) {
    double product = 0;
    for (int i = ATTITUDE; i < ATTITUDE + 4; i++) product += states[i] * x[i];
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

static int control(flight *f, integer k) {
    const integer X_size = STATES * (f->nodes + 1), U_size = f->inputs * f->nodes, *rows = f->where + k * f->reference_rows;
    const double *x = f->told, *wanted = f->along + STATES * k, *X_new = f->X_new, *U_new = f->U_new;
    double status = 0, sweeps = 0, active = 0;
    if (!(distance(f->x, wanted) <= f->near) || !(distance(x, wanted) <= f->reach)) return 0;
    if (!ordinary(f->x, STATES) || !ordinary(x, STATES)) return 0;

    const double began = seconds();
    copy(f->x0, x, STATES);
    for (integer i = 0; i < f->reference_rows; i++) copy(f->X_ref + STATES * i, f->states + STATES * rows[i], STATES);
    for (integer i = 0; i < f->reference_rows - 1; i++) copy(f->U_ref + f->inputs * i, f->thrusts + f->inputs * rows[i], f->inputs);
    if (!to_side(f->X_ref, f->reference_rows, x) || !to_side(f->X, f->nodes + 1, x)) return 0;
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

    copy(f->log_state + STATES * k, f->x, STATES);
    if (f->log_estimate) copy(f->log_estimate + STATES * k, x, STATES);
    copy(f->log_input + f->inputs * k, f->U, f->inputs);
    copy(f->log_reading + 3 * k, f->reading, 3);
    for (integer i = 0; i < f->logged_size; i++) f->log_inner[f->logged_size * k + i] = f->inner[f->logged[i]];
    const double record[RECORD] = {seconds() - began, status, sweeps, active, kkt, 1};
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
    if (run(&f->plant) || !ordinary(f->x_next, STATES)) return 0;
    for (integer i = 0; i < f->doubt_size; i++)
        if (f->doubt[i] != 0) return 0;
    copy(f->x, f->x_next, STATES);
    if (f->measured) copy(f->told, f->measured, STATES);
    copy(f->inner, f->inner_next, f->inner_size);
    copy(f->reading, f->specific_force, 3);
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
