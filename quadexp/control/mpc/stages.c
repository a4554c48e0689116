/* The control step as loops over the stages (step.py says what it computes): mpc_prepare, mpc_feedback, mpc_bounded on
   one set of arrays, for any number N of nodes. Freestanding C11: no allocation, of libraries only math.h.

   Declared before: STATES m, N_INPUTS n, SAMPLES s, FRAMES, LAG, DISTURBED, LENGTH_MIN, LENGTH_MAX, see node.py; IN_..
   and OUT_.., places of the arrays of step.py in `arg` and `res`, null where the form has none. iw: N, and the number p
   of the model's parameters; w: as many numbers as mpc_memory says, aligned to 64 bytes. The functions of a node are
   another object, of node.py: linearise, held and frame; node_lanes is linearise at as many nodes as a register has
   lanes. Compiled with -ffast-math: whether a number is finite is seen from its bits alone. With SCALAR defined a vector
   is a plain number, for processors without vector registers and compilers without vector types. */
#include <math.h>

#ifndef REAL
#define REAL double
#endif
#ifndef INTEGER
#define INTEGER long long
#endif
#if defined(SCALAR)
enum { LANES = 1 };
#elif defined(__AVX512F__)
enum { LANES = 8 };
#elif defined(__AVX__)
enum { LANES = 4 };
#else
enum { LANES = 2 };
#endif

typedef REAL real;
typedef INTEGER integer;
#ifdef SCALAR
typedef real vector;
#define LANE(v, l) (v) /* of a vector, to be written too */
#else
typedef real vector __attribute__((vector_size(sizeof(real) * LANES), aligned(8), may_alias));
typedef real lanes __attribute__((vector_size(sizeof(real) * LANES))); /* one number of LANES nodes */
#define LANE(v, l) (v)[l]
#endif

enum { PLACE = 3, ATTITUDE = 3, MOTION = STATES - PLACE, AFFINE = MOTION + N_INPUTS };
enum { WIDTH = LANES > 1 ? 8 : 1, LINE = (AFFINE / WIDTH + 1) * WIDTH }; /* as Form.line */
enum { BLOCK = STATES * LINE, USED = (AFFINE / LANES + 1) * LANES, COST = BLOCK + PLACE * PLACE };
enum { PUSHED = 6 }; /* numbers of a disturbance */
enum { IS_DOUBLE = sizeof(real) == 8 };

#define HIDDEN __attribute__((visibility("hidden")))
HIDDEN void node_linearise(const real *const *given, real *const *results, real *work);
#ifndef SCALAR
HIDDEN extern const integer node_memory, has_lanes; /* numbers for work; whether there is node_lanes */
HIDDEN void node_lanes(const lanes *const *given, lanes *const *results, lanes *work);
#endif
HIDDEN void node_held(const real *const *given, real *const *results, real *work);
HIDDEN void node_frame(const real *const *given, real *const *results, real *work);

#ifdef __FAST_MATH__
static int is_finite(real number) {
  unsigned long long bits = 0;
  __builtin_memcpy(&bits, &number, sizeof(number));
  return IS_DOUBLE ? (bits >> 52 & 0x7ff) != 0x7ff : (bits >> 23 & 0xff) != 0xff;
}

static real not_a_number(void) {
  const unsigned long long bits = IS_DOUBLE ? 0x7ff8000000000000 : 0x7fc00000;
  real number;
  __builtin_memcpy(&number, &bits, sizeof(number));
  return number;
}
#else
static int is_finite(real number) { return isfinite(number); }

static real not_a_number(void) { return NAN; }
#endif

static inline real largest(real a, real b) { return a > b ? a : b; }

static inline real limited(real value, real low, real high) {
  return value > high ? high : value < low ? low : value;
}

#ifdef SCALAR
#include "riccati_scalar.c"
#else
#include "riccati_backward.c"
#endif
#include "active_set.c"

/* The length of a quaternion brought between a half and two. */
static void guard(real *x) {
  real *q = x + ATTITUDE;
  const real length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const real scale = limited(length, LENGTH_MIN, LENGTH_MAX) / length;
  for (int i = 0; i < 4; ++i) q[i] *= scale;
}

/* The attitude in the cost's coordinates, L'q, and back, L e: L (4, 4) by columns. */
static void into(const real *L, real *x) {
  real q[4];
  for (int i = 0; FRAMES && i < 4; ++i) {
    q[i] = 0;
    for (int j = 0; j < 4; ++j) q[i] += L[4 * i + j] * x[ATTITUDE + j];
  }
  for (int i = 0; FRAMES && i < 4; ++i) x[ATTITUDE + i] = q[i];
}

static void out_of(const real *L, real *x) {
  real q[4] = {0};
  for (int j = 0; FRAMES && j < 4; ++j)
    for (int i = 0; i < 4; ++i) q[i] += L[4 * j + i] * x[ATTITUDE + j];
  for (int i = 0; FRAMES && i < 4; ++i) x[ATTITUDE + i] = q[i];
}

static const real *frame_of(real **res, integer k) { return FRAMES ? res[OUT_frames] + 16 * k : 0; }

/* Rows of node k, linearised at x. */
static void linearise_node(const real **arg, real **res, integer k, const real *x, real *work) {
  const real *given[] = {x,
                         res[OUT_U_lin] + N_INPUTS * k,
                         arg[IN_theta],
                         arg[IN_dt] + k,
                         res[OUT_X_lin] + STATES * (k + 1),
                         arg[IN_tau],
                         SAMPLES > 1 ? res[OUT_added] + 3 * N_INPUTS * k : 0,
                         arg[IN_disturbance],
                         frame_of(res, k),
                         frame_of(res, k + 1)};
  real *const rows = res[OUT_rows] + BLOCK * k;
  node_linearise(given, &rows, work);
}

#ifndef SCALAR
/* Numbers of the nodes `first` .. `last` - 1, LANES at most, side by side: `size` of each. */
static const lanes *side_by_side(lanes *to, const real *from, int size, integer first, integer last) {
  for (int l = 0; l < LANES; ++l) {
    const real *of_node = from + size * (first + l < last ? first + l : last - 1);
    for (int i = 0; i < size; ++i) to[i][l] = of_node[i];
  }
  return to;
}

/* Of every 2 h lanes, the upper h of a for the lower h of b. */
static inline void exchange(vector *a, vector *b, int h) {
  const vector low = *a, high = *b;
#ifdef __AVX512F__
  if (h == 1) {
    *a = __builtin_shufflevector(low, high, 0, 8, 2, 10, 4, 12, 6, 14);
    *b = __builtin_shufflevector(low, high, 1, 9, 3, 11, 5, 13, 7, 15);
  } else if (h == 2) {
    *a = __builtin_shufflevector(low, high, 0, 1, 8, 9, 4, 5, 12, 13);
    *b = __builtin_shufflevector(low, high, 2, 3, 10, 11, 6, 7, 14, 15);
  } else {
    *a = __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11);
    *b = __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15);
  }
#elif defined(__AVX__)
  if (h == 1) {
    *a = __builtin_shufflevector(low, high, 0, 4, 2, 6);
    *b = __builtin_shufflevector(low, high, 1, 5, 3, 7);
  } else {
    *a = __builtin_shufflevector(low, high, 0, 1, 4, 5);
    *b = __builtin_shufflevector(low, high, 2, 3, 6, 7);
  }
#else
  for (int l = 0; l < LANES; ++l) {
    (*a)[l] = l & h ? high[l - h] : low[l];
    (*b)[l] = l & h ? high[l] : low[l + h];
  }
#endif
}

/* Numbers that all nodes have. */
static const lanes *in_all(lanes *to, const real *from, integer size) {
  for (integer i = 0; i < size; ++i) to[i] = from[i] - (lanes){0};
  return to;
}

/* The other way round, rows of `count` nodes: blocks are transposed, each time exchanging halves of half the size. */
static void apart(real *to, const lanes *rows, integer count) {
  for (int j = 0; j < BLOCK; j += LANES) {
    vector v[LANES];
    for (int l = 0; l < LANES; ++l) v[l] = rows[j + l];
    for (int half = 1; half < LANES; half *= 2)
      for (int l = 0; l < LANES; ++l)
        if (!(l & half)) exchange(v + l, v + l + half, half);
    for (integer l = 0; l < count; ++l) *(vector *)(to + BLOCK * l + j) = v[l];
  }
}

/* Rows of the nodes `first` .. `last` - 1, LANES at most. */
static void linearise_side_by_side(const real **arg, real **res, const lanes *theta, integer first, integer last,
                                   lanes *work) {
  lanes x[STATES], next[STATES], u[N_INPUTS], dt[1], tau[1], added[3 * N_INPUTS], pushed[PUSHED], frames[2][16];
  lanes rows[BLOCK], *const results = rows;
  const lanes *given[] = {side_by_side(x, res[OUT_X_lin], STATES, first, last),
                          side_by_side(u, res[OUT_U_lin], N_INPUTS, first, last),
                          theta,
                          side_by_side(dt, arg[IN_dt], 1, first, last),
                          side_by_side(next, res[OUT_X_lin] + STATES, STATES, first, last),
                          LAG ? in_all(tau, arg[IN_tau], 1) : 0,
                          SAMPLES > 1 ? side_by_side(added, res[OUT_added], 3 * N_INPUTS, first, last) : 0,
                          DISTURBED ? in_all(pushed, arg[IN_disturbance], PUSHED) : 0,
                          FRAMES ? side_by_side(frames[0], frame_of(res, 0), 16, first, last) : 0,
                          FRAMES ? side_by_side(frames[1], frame_of(res, 1), 16, first, last) : 0};
  node_lanes(given, &results, work);
  apart(res[OUT_rows] + BLOCK * first, rows, last - first);
}

#endif

/* Rows of the nodes 1 .. N - 1. */
static void linearise_all(const real **arg, real **res, integer nodes, integer parameters, real *w) {
  integer k = 1;
#ifndef SCALAR
  lanes *const theta = (lanes *)w, *const work = theta + parameters;
  if (has_lanes) {
    in_all(theta, arg[IN_theta], parameters);
    for (; k < nodes - 1; k += LANES)
      linearise_side_by_side(arg, res, theta, k, nodes < k + LANES ? nodes : k + LANES, work);
  }
#else
  (void)parameters;
#endif
  for (; k < nodes; ++k) linearise_node(arg, res, k, res[OUT_X_lin] + STATES * k, w);
}

/* The largest component of the projected gradient step of one node. */
static real projected(const real *u, const real *gradient, const real *low, const real *high) {
  real most = 0;
  for (int a = 0; a < N_INPUTS; ++a)
    most = largest(most, fabs(u[a] - limited(u[a] - gradient[a], low[a], high[a])));
  return most;
}

/* multiplier <- q + A' multiplier; gradient = r + B' multiplier, with the multiplier before. */
static void adjoint(real *multiplier, const real *rows, const real *q, const real *r, real *gradient) {
  vector sums[USED / LANES];
  real both[USED];
  for (int j = 0; j < USED / LANES; ++j) sums[j] = (vector){0};
  for (int i = 0; i < STATES; ++i)
    for (int j = 0; j < USED / LANES; ++j) sums[j] += multiplier[i] * *(const vector *)(rows + i * LINE + j * LANES);
  for (int j = 0; j < USED / LANES; ++j) *(vector *)(both + j * LANES) = sums[j];
  for (int i = 0; i < PLACE; ++i) multiplier[i] += q[i];
  for (int i = 0; i < MOTION; ++i) multiplier[PLACE + i] = q[PLACE + i] + both[i];
  for (int a = 0; a < N_INPUTS; ++a) gradient[a] = r[a] + both[MOTION + a];
}

/* The largest gap of the dynamics of one node. */
static real gap(const real *rows) {
  real most = 0;
  for (int i = 0; i < STATES; ++i) most = largest(most, fabs(rows[i * LINE + AFFINE]));
  return most;
}

/* Linearisation point of the nodes, and gradients of the cost there. */
static void move_and_weigh(const real **arg, real **res, integer nodes, real *work) {
  static const real one = 1;
  const real *X = arg[IN_X], *U = arg[IN_U], *shift = arg[IN_shift];
  for (integer k = 1; k <= nodes; ++k) {
    real *x = res[OUT_X_lin] + STATES * k, *q = res[OUT_q] + STATES * k;
    const real *weight = k < nodes ? arg[IN_Q] + STATES * k : arg[IN_Q_end];
    const real *from = X + STATES * k, *to = k < nodes ? from + STATES : from, share = k < nodes ? shift[k] : 0;
    for (int i = 0; i < STATES; ++i) x[i] = from[i] + share * (to[i] - from[i]);
    guard(x);
    for (int i = 0; i < STATES; ++i) q[i] = x[i] - arg[IN_X_ref][SAMPLES * STATES * k + i];
    into(frame_of(res, k), q);
    for (int i = 0; i < STATES; ++i) q[i] *= weight[i];
  }
  for (integer k = 0; k < nodes; ++k) {
    const int last = k == nodes - 1;
    real *u = res[OUT_U_lin] + N_INPUTS * k, *r = res[OUT_r] + N_INPUTS * k, reference[N_INPUTS];
    const real *from = U + N_INPUTS * k, *to = last ? from : from + N_INPUTS, share = last ? 0 : shift[k];
    const real *thrusts = arg[IN_U_ref] + SAMPLES * N_INPUTS * k;
    for (int a = 0; a < N_INPUTS; ++a) u[a] = from[a] + share * (to[a] - from[a]);
    if (SAMPLES > 1) { /* the thrust at the end of the last node is extrapolated */
      real sampled[3][N_INPUTS];
      for (int i = 0; i < 3 - last; ++i)
        for (int a = 0; a < N_INPUTS; ++a)
          sampled[i][a] = limited(thrusts[N_INPUTS * i + a], arg[IN_u_min][a], arg[IN_u_max][a]);
      for (int a = 0; last && a < N_INPUTS; ++a) sampled[2][a] = 2 * sampled[1][a] - sampled[0][a];
      const real *given[] = {sampled[0],    sampled[1],    sampled[2], arg[IN_dt] + k, k ? &one : arg[IN_first_share],
                             arg[IN_u_min], arg[IN_u_max], arg[IN_tau]};
      real *const results[] = {reference, res[OUT_added] + 3 * N_INPUTS * k};
      node_held(given, results, work);
    }
    for (int a = 0; a < N_INPUTS; ++a)
      r[a] = arg[IN_R][N_INPUTS * k + a] * (u[a] - (SAMPLES > 1 ? reference : thrusts)[a]);
  }
}

/* What stands behind S once it is made, 7 n N + 2 (m + 2 n) N, needs less than its making did, (m + 2 n) n N. */
#define BOUNDED_MEMORY(nodes) (INVERSE_HESSIAN(nodes) + INVERSE_HESSIAN_MEMORY(nodes))
#ifndef SCALAR
/* Of w, for N nodes and p parameters. */
integer mpc_memory(integer nodes, integer parameters) {
  const integer node = has_lanes ? LANES * (node_memory + parameters) : node_memory;
  const integer bounded = BOUNDED_MEMORY(nodes);
  return node > bounded ? node : bounded;
}
#endif

/* What does not depend on the measured state. */
int mpc_prepare(const real **arg, real **res, integer *iw, real *w, int memory) {
  const integer nodes = iw[0];
  const real *q = res[OUT_q], *r = res[OUT_r], *Q_end = arg[IN_Q_end];
  real costs[2][COST] __attribute__((aligned(64))), *cost = costs[1], *next = costs[0];
  real *multiplier = res[OUT_multiplier], kkt = 0, gradient[N_INPUTS];
  (void)memory;
  for (integer k = 0; FRAMES && k <= nodes; ++k) {
    const real *x_ref = arg[IN_X_ref] + SAMPLES * STATES * k;
    real *const matrix = res[OUT_frames] + 16 * k;
    node_frame(&x_ref, &matrix, w);
  }
  move_and_weigh(arg, res, nodes, w);
  linearise_all(arg, res, nodes, iw[1], w);

  for (int i = 0; i < COST; ++i) cost[i] = 0;
  for (int i = 0; i < STATES; ++i) multiplier[i] = cost[i * LINE + AFFINE] = q[STATES * nodes + i];
  for (int i = 0; i < MOTION; ++i) cost[(PLACE + i) * LINE + i] = Q_end[PLACE + i];
  for (int i = 0; i < PLACE; ++i) cost[BLOCK + i * (PLACE + 1)] = Q_end[i];
  for (integer k = nodes - 1; k > 0; --k) {
    const integer x = STATES * k, u = N_INPUTS * k;
    const real *M = res[OUT_rows] + BLOCK * k;
    real *before = k > 1 ? next : res[OUT_cost];
    riccati(cost, M, q + x, r + u, arg[IN_Q] + x, arg[IN_R] + u, before, res[OUT_K] + x * N_INPUTS, res[OUT_k] + u,
            res[OUT_factor] + u * N_INPUTS);
    next = cost, cost = before;
    adjoint(multiplier, M, q + x, r + u, gradient);
    kkt = largest(kkt, gap(M));
    kkt = largest(kkt, projected(res[OUT_U_lin] + u, gradient, arg[IN_u_min], arg[IN_u_max]));
  }
  if (nodes == 1) __builtin_memcpy(res[OUT_cost], cost, sizeof(real) * COST);
  res[OUT_kkt][0] = kkt;
  return 0;
}

/* rows of M times [s, u, 1]. */
static real across(const real *M, const real *moving) {
  vector part = *(const vector *)M * *(const vector *)moving;
  for (int j = LANES; j < USED; j += LANES) part += *(const vector *)(M + j) * *(const vector *)(moving + j);
  real sum[LANES];
  *(vector *)sum = part;
  for (int half = LANES / 2; half; half /= 2)
    for (int i = 0; i < half; ++i) sum[i] = sum[2 * i] + sum[2 * i + 1];
  return sum[0];
}

/* Node 0 at the measured state, and the answer without bounds. */
int mpc_feedback(const real **arg, real **res, integer *iw, real *w, int memory) {
  const integer nodes = iw[0];
  const real *const x0 = arg[IN_x0], *const low = arg[IN_u_min], *const high = arg[IN_u_max];
  real *const X_lin = res[OUT_X_lin], *const q = res[OUT_q], *const rows = res[OUT_rows];
  real *const X_new = res[OUT_X_new], *const U_new = res[OUT_U_new], *const checks = res[OUT_checks];
  (void)memory;
  for (int i = 0; i < STATES; ++i) {
    X_new[i] = X_lin[i] = x0[i];
    q[i] = x0[i] - arg[IN_X_ref][i];
  }
  into(frame_of(res, 0), q);
  for (int i = 0; i < STATES; ++i) q[i] *= arg[IN_Q][i];
  linearise_node(arg, res, 0, x0, w);
  riccati(res[OUT_cost], rows, q, res[OUT_r], arg[IN_Q], arg[IN_R], 0, 0, res[OUT_k], res[OUT_factor]);

  /* The change of the state, position apart, and of the input, as a column of M's. */
  real moving[LINE] __attribute__((aligned(64))) = {0}, place[PLACE] = {0};
  real excess = (real)-1e30, turn = 0, size = 0;
  moving[AFFINE] = 1;
  for (integer k = 0; k < nodes; ++k) {
    const real *K = res[OUT_K] + k * STATES * N_INPUTS, *M = rows + BLOCK * k, *u = res[OUT_U_lin] + N_INPUTS * k;
    real du[N_INPUTS], dx[STATES], length = 0;
    for (int a = 0; a < N_INPUTS; ++a) du[a] = -res[OUT_k][N_INPUTS * k + a];
    for (int i = 0; k > 0 && i < STATES; ++i)
      for (int a = 0; a < N_INPUTS; ++a) du[a] -= K[i * N_INPUTS + a] * (i < PLACE ? place[i] : moving[i - PLACE]);
    for (int a = 0; a < N_INPUTS; ++a) {
      moving[MOTION + a] = du[a];
      const real moved = U_new[N_INPUTS * k + a] = u[a] + du[a];
      excess = largest(excess, largest(moved - high[a], low[a] - moved));
      size += fabs(moved);
    }
    for (int i = 0; i < STATES; ++i) dx[i] = (i < PLACE ? place[i] : 0) + across(M + i * LINE, moving);
    for (int i = 0; i < PLACE; ++i) place[i] = dx[i];
    for (int i = 0; i < MOTION; ++i) moving[i] = dx[PLACE + i];
    for (int i = ATTITUDE; i < ATTITUDE + 4; ++i) length += dx[i] * dx[i];
    turn = largest(turn, length);
    out_of(frame_of(res, k + 1), dx);
    for (int i = 0; i < STATES; ++i) {
      const integer j = STATES * (k + 1) + i;
      X_new[j] = X_lin[j] + dx[i];
      size += fabs(X_new[j]);
    }
  }
  real multiplier[STATES], gradient[N_INPUTS], kkt = largest(res[OUT_kkt][0], gap(rows));
  for (int i = 0; i < STATES; ++i) multiplier[i] = res[OUT_multiplier][i];
  adjoint(multiplier, rows, q, res[OUT_r], gradient);
  checks[0] = is_finite(size) ? excess : not_a_number();
  checks[1] = sqrt(turn);
  checks[2] = largest(kkt, projected(res[OUT_U_lin], gradient, low, high));
  return 0;
}

/* The answer within the bounds, from the factorisation of the other two. */
int mpc_bounded(const real **arg, real **res, integer *iw, real *w, int memory) {
  const integer nodes = iw[0], inputs = N_INPUTS * nodes, states = STATES * nodes;
  const real *U_lin = res[OUT_U_lin], *low = arg[IN_u_min], *high = arg[IN_u_max];
  real *X = res[OUT_bounded_X], *U = res[OUT_bounded_U], turn = 0;
  real *const tail = w + INVERSE_HESSIAN(nodes), *const dX = tail + ACTIVE_SET_MEMORY(nodes);
  real *const weights = dX + states, *const dU = weights + states;
  real *const start = dU + inputs, *const below = start + inputs, *const above = below + inputs;
  (void)memory;
  inverse_hessian(nodes, res[OUT_rows], res[OUT_K], res[OUT_factor], w, tail);
  for (integer j = 0; j < inputs; ++j) {
    start[j] = res[OUT_U_new][j] - U_lin[j];
    below[j] = low[j % N_INPUTS] - U_lin[j];
    above[j] = high[j % N_INPUTS] - U_lin[j];
  }
  for (integer j = 0; j < states; ++j)
    weights[j] = j < states - STATES ? arg[IN_Q][STATES + j] : arg[IN_Q_end][j - states + STATES];
  active_set(nodes, res[OUT_rows], res[OUT_q], res[OUT_r], weights, arg[IN_R], start, below, above, arg[IN_guess], w,
             tail, dX, dU, res[OUT_side], res[OUT_bounded_checks]);
  for (int i = 0; i < STATES; ++i) X[i] = res[OUT_X_lin][i];
  for (integer k = 1; k <= nodes; ++k) {
    real *d = dX + STATES * (k - 1), length = 0;
    for (int i = ATTITUDE; i < ATTITUDE + 4; ++i) length += d[i] * d[i];
    turn = largest(turn, length);
    out_of(frame_of(res, k), d);
    for (int i = 0; i < STATES; ++i) X[STATES * k + i] = res[OUT_X_lin][STATES * k + i] + d[i];
  }
  for (integer j = 0; j < inputs; ++j) /* limited: rounding only */
    U[j] = limited(U_lin[j] + dU[j], low[j % N_INPUTS], high[j % N_INPUTS]);
  res[OUT_bounded_checks][4] = sqrt(turn);
  return 0;
}
