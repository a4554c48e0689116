/* Control periods of a flight, one after another, as the loop of rollout.py makes them: a control instant, by
   quadexp/control/loop.c, which stands before this text, then the plant's period. Every number and its place are the
   Python loop's own, so that at any instant the one may take over from the other. What is out of the ordinary is left
   to Python, before anything has been changed, or after it was changed back: `fly` then returns where it is.
   compiled_flight.py reads the structure. */

#include <time.h>

enum { RECORD = 6 };

typedef struct {
    loop *loop;
    const reference *reference;
    const real *along; /* its states at the instants */
    real near;
    function plant;
    integer inner_size, logged_size, extra_size, noise_size, noise_argument, draws_argument, draws_at, doubt_size;
    real *plant_x, *plant_inner, *plant_u, *plant_time; /* plant_time, measured: null but in a world */
    const real *x_next, *inner_next, *specific_force, *doubt, *measured;
    const real *noise; /* of the periods first_drawn .. end_drawn - 1, each its noise and then its draws */
    integer first_drawn, end_drawn;
    /* now, as it is; which inner states are rotor speeds, null where there are none */
    real *x, *inner;
    const integer *rotors;
    real time, next_change;
    integer commanded; /* whether the control step of the instant has been made, and its period not yet flown */
    /* command and rotors at a limit: what the calls leave; held: null with a plan */
    const real *command, *held;
    /* log, a row a control instant */
    const integer *logged; /* which inner states */
    const real *const *extra;
    const integer *extra_sizes;
    integer extra_arrays;
    real *log_state, *log_input, *log_reading, *log_inner, *log_record, *log_estimate, *log_extra; /* may be null */
} flight;

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int command(flight *f, integer k) {
    const loop *l = f->loop;
    if (!(distance(f->x, f->along + BODY * k) <= f->near) || !ordinary(f->x, BODY, LARGEST)) return 0;
    const real began = seconds();
    if (!admitted(l, l->state, l->specific_force, f->rotors ? l->rotor_speed : 0) || !control(l, k, f->reference, k)) return 0;

    copy(f->log_state + BODY * k, f->x, BODY);
    if (f->log_estimate) copy(f->log_estimate + BODY * k, l->state, BODY);
    copy(f->log_input + l->inputs * k, f->command, l->inputs);
    copy(f->log_reading + 3 * k, l->specific_force, 3);
    for (integer i = 0; i < f->logged_size; i++) f->log_inner[f->logged_size * k + i] = f->inner[f->logged[i]];
    real *row = f->log_extra + f->extra_size * k;
    for (integer i = 0; i < f->extra_arrays; row += f->extra_sizes[i++]) copy(row, f->extra[i], f->extra_sizes[i]);
    const mpc *p = l->plan;
    real *record = f->log_record + RECORD * k;
    record[1] = p ? p->status : 0, record[2] = p ? p->sweeps : 0, record[3] = p ? p->active : *f->held;
    record[4] = p ? p->kkt : 0, record[5] = p ? p->converged : 1, record[0] = seconds() - began;
    return 1;
}

static int advance(flight *f, integer k) {
    loop *l = f->loop;
    if (k < f->first_drawn || k >= f->end_drawn || f->next_change <= f->time + 1e-9) return 0;
    copy(f->plant_x, f->x, BODY);
    copy(f->plant_inner, f->inner, f->inner_size);
    copy(f->plant_u, f->log_input + l->inputs * k, l->inputs);
    f->plant.arguments[f->noise_argument] = f->noise + f->noise_size * (k - f->first_drawn);
    if (f->plant_time) {
        *f->plant_time = f->time;
        f->plant.arguments[f->draws_argument] = f->plant.arguments[f->noise_argument] + f->draws_at;
    }
    if (run(&f->plant) || !ordinary(f->x_next, BODY, HUGE_NUMBER)) return 0;
    for (integer i = 0; i < f->doubt_size; i++)
        if (f->doubt[i] != 0) return 0;
    copy(f->x, f->x_next, BODY);
    copy(l->state, f->measured ? f->measured : f->x, BODY);
    copy(f->inner, f->inner_next, f->inner_size);
    copy(l->specific_force, f->specific_force, 3);
    if (f->rotors)
        for (integer i = 0; i < l->inputs; i++) l->rotor_speed[i] = f->inner[f->rotors[i]];
    f->time += l->period;
    return 1;
}

/* Flies from control instant k on; returns the instant at which Python is needed, or `samples`. */
integer fly(flight *f, integer k) {
    for (;; k++) {
        if (!f->commanded && (k >= f->reference->instants || !command(f, k))) return k;
        f->commanded = 1;
        if (!advance(f, k)) return k;
        f->commanded = 0;
    }
}
