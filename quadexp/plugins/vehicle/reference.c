/* References for a controller: a point to hold, and flat outputs by the closed form of quadexp/reference/flat_map.py
   without the air, whose equations (2) to (5) these are; with a prescribed heading.

   Declared before: ROTORS, ROWS, hover, mass (kg), gravity (m/s^2), inertia (kg m^2), allocation: thrusts of thrust (N)
   and torques (N m). */

/* Hover at a position (m) with a heading (rad). */
void QX(hold)(window *w, const real position[3], real heading) {
    static const window nothing;
    *w = nothing;
    for (int k = 0; k < ROWS; k++) {
        copy(w->states[k], position, 3);
        w->states[k][ATTITUDE] = cos(heading / 2);
        w->states[k][ATTITUDE + 3] = sin(heading / 2);
    }
    for (int k = 0; k < ROWS - 1; k++) copy(w->inputs[k], hover, ROTORS);
    copy(w->path[0], position, 3);
    w->yaw[0] = heading;
}

static void cross(const real *a, const real *b, real *to) {
    to[0] = a[1] * b[2] - a[2] * b[1];
    to[1] = a[2] * b[0] - a[0] * b[2];
    to[2] = a[0] * b[1] - a[1] * b[0];
}

/* R_t' v, for the tilt q_w, q_x, q_y. */
static void into_tilt(const real *q, const real *v, real *to) {
    const real upright = 1 - 2 * (q[1] * q[1] + q[2] * q[2]), around = 2 * (q[1] * v[0] + q[2] * v[1]);
    const real up = 2 * q[0] * v[2];
    to[0] = v[0] * upright + q[1] * around - q[2] * up;
    to[1] = v[1] * upright + q[2] * around + q[1] * up;
    to[2] = v[2] * upright + 2 * q[0] * (q[2] * v[0] - q[1] * v[1]);
}

/* The o with (o x f)_xy = p, f = (0, 0, c), and (-q_y, q_x, q_w) . o = 0. */
static void turning_of(const real *q, real c, const real *p, real *o) {
    o[0] = -p[1] / c;
    o[1] = p[0] / c;
    o[2] = -(q[1] * p[0] + q[2] * p[1]) / (q[0] * c);
}

static void twisted(const real *v, real cosine, real sine, real *to) {
    to[0] = cosine * v[0] + sine * v[1];
    to[1] = cosine * v[1] - sine * v[0];
    to[2] = v[2];
}

/* State, and thrusts where there is room for them, of one flat output. */
static int flat_state(const QX(output) *output, real *x, real *thrusts) {
    const real *a = output->path[2], *yaw = output->yaw;
    const real F[3] = {a[0], a[1], a[2] + gravity}, c = sqrt(F[0] * F[0] + F[1] * F[1] + F[2] * F[2]);
    const real length = sqrt(2 * c * (c + F[2]));
    if (!(c > (real)1e-3 * gravity) || !(length > (real)1e-3 * c)) return 0;
    const real q[3] = {(c + F[2]) / length, -F[1] / length, F[0] / length};
    real jerk[3], snap[3], o[3], o_dot[3], part[3], other[3];
    into_tilt(q, output->path[3], jerk);
    into_tilt(q, output->path[4], snap);
    turning_of(q, c, jerk, o);
    const real f[3] = {0, 0, c};
    cross(o, f, part);
    for (int i = 0; i < 3; i++) part[i] = 2 * jerk[i] - part[i];
    cross(o, part, other);
    for (int i = 0; i < 3; i++) snap[i] -= other[i];
    turning_of(q, c, snap, o_dot);

    const real forward[3] = {cos(yaw[0]), sin(yaw[0]), 0}, left[3] = {-sin(yaw[0]), cos(yaw[0]), 0};
    real h[3], e[3], turn[3], turn_dot[3];
    into_tilt(q, forward, part);
    const real chi = atan2(part[1], part[0]), cosine = cos(chi), sine = sin(chi);
    twisted(part, cosine, sine, h);
    into_tilt(q, left, part);
    twisted(part, cosine, sine, e);
    twisted(o, cosine, sine, turn);
    twisted(o_dot, cosine, sine, turn_dot);
    turn[2] = (yaw[1] * e[1] + turn[0] * h[2]) / h[0];
    const real chi_dot = turn[2] - o[2];
    turn_dot[0] += chi_dot * turn[1];
    turn_dot[1] -= chi_dot * turn[0];
    cross(turn, e, part);
    real right = yaw[2] * e[1] - 2 * yaw[1] * part[1];
    cross(turn, h, part);
    cross(turn, part, other);
    right += other[1];
    turn_dot[2] = (right + turn_dot[0] * h[2]) / h[0];

    const real half_cosine = cos(chi / 2), half_sine = sin(chi / 2);
    copy(x, output->path[0], 3);
    x[3] = q[0] * half_cosine;
    x[4] = q[1] * half_cosine + q[2] * half_sine;
    x[5] = q[2] * half_cosine - q[1] * half_sine;
    x[6] = q[0] * half_sine;
    copy(x + 7, output->path[1], 3);
    copy(x + 10, turn, 3);
    if (!thrusts) return 1;
    real momentum[3], wrench[4] = {mass * c, 0, 0, 0};
    for (int i = 0; i < 3; i++) {
        momentum[i] = inertia[i][0] * turn[0] + inertia[i][1] * turn[1] + inertia[i][2] * turn[2];
        wrench[1 + i] = inertia[i][0] * turn_dot[0] + inertia[i][1] * turn_dot[1] + inertia[i][2] * turn_dot[2];
    }
    cross(turn, momentum, part);
    for (int i = 0; i < 3; i++) wrench[1 + i] += part[i];
    for (int i = 0; i < ROTORS; i++) {
        thrusts[i] = 0;
        for (int j = 0; j < 4; j++) thrusts[i] += allocation[i][j] * wrench[j];
    }
    return 1;
}

int QX(flat)(window *w, const QX(output) outputs[ROWS + 1]) {
    static window made;
    for (int k = 0; k < ROWS; k++) {
        real *x = made.states[k];
        if (!flat_state(outputs + 1 + k, x, k < ROWS - 1 ? made.inputs[k] : 0)) return 0;
        const real *before = k ? made.states[k - 1] : 0;
        if (k ? attitudes_product(x, before) < 0 : x[ATTITUDE] < 0)
            for (int i = ATTITUDE; i < ATTITUDE + 4; i++) x[i] = -x[i];
    }
    copy(&made.path[0][0], &outputs->path[0][0], PATH);
    copy(made.yaw, outputs->yaw, 3);
    made.yaw[3] = 0;
    *w = made;
    return 1;
}
