/* The bounded subproblem by a dual active set on the Riccati factorisation, as the body of a compiled function (see
   active_set.py for the method and the numpy twin of this file, which has the same steps in the same order).

   Declared before: N_INPUTS = n, NODES = N; in: rows (of every node, as in riccati_backward.c), K (n, 13 N), factor
   (n, n N: L below the diagonal, D^-1 on it, of H_k = L D L'), q (13, N + 1), r (n, N), Q (13, N: of the nodes 1..N),
   R (n, N), start (n, N), low, high (n, N), guess (n, N); out: dX (13, N), dU (n, N), side (n, N), checks (4). All are
   stored by columns: the numbers of one node lie side by side. */
#if defined(__AVX512F__)
enum { LANES = 8 };
#elif defined(__AVX__)
enum { LANES = 4 };
#else
enum { LANES = 2 };
#endif
typedef double vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
enum { PLACE = 3, MOTION = 10, STATES = PLACE + MOTION, AFFINE = MOTION + N_INPUTS, ROW = (AFFINE / 8 + 1) * 8 };
enum { SIZE = NODES * N_INPUTS, LINE = (SIZE + 7) / 8 * 8, MOST = 10 * SIZE, ROUNDS = 4 };
const double tolerance = 1e-10, loose = 1e-7, huge = 1e300;

/* An exponent of ones is not a number; -ffast-math lets the compiler believe that there is none. */
#define FINITE(number) (((union { double value; unsigned long long bits; }){number}.bits >> 52 & 0x7ff) != 0x7ff)
/* First column that row i of S holds: S is symmetric, and kept in whole vectors on and above its diagonal. */
#define FROM(i) ((i) / 8 * 8)

const double(*M)[STATES][ROW] = (const double(*)[STATES][ROW])rows;
for (int i = 0; i < 4; ++i) checks[i] = 0.0;
double *memory = __builtin_malloc(sizeof(double) * (SIZE + 1) * LINE);
if (!memory) return 0;
double(*S)[LINE] = (double(*)[LINE])((((__UINTPTR_TYPE__)memory) + 63) / 64 * 64);

/* S = M = H^-1 of the condensed problem. One backward pass with a unit gradient in every input of every node: column j
   of p and h belongs to input j; M is the sum over the nodes of h' H_k^-1 h. */
{
  double p[STATES][LINE] __attribute__((aligned(64))), h[N_INPUTS][LINE] __attribute__((aligned(64)));
  double scaled[N_INPUTS][LINE] __attribute__((aligned(64)));
  for (int i = 0; i < STATES; ++i)
    for (int j = 0; j < LINE; ++j) p[i][j] = 0.0;
  for (int i = 0; i < SIZE; ++i)
    for (int j = FROM(i); j < LINE; ++j) S[i][j] = 0.0;
  for (int k = NODES - 1; k >= 0; --k) {
    const double(*gain)[N_INPUTS] = (const double(*)[N_INPUTS])(K + k * STATES * N_INPUTS);
    const double(*L)[N_INPUTS] = (const double(*)[N_INPUTS])(factor + k * N_INPUTS * N_INPUTS);
    const int own = k * N_INPUTS;
    for (int j = FROM(own); j < LINE; j += LANES) {
      vector before[STATES], after[MOTION], gradient[N_INPUTS];
      for (int c = 0; c < STATES; ++c) before[c] = *(const vector *)(p[c] + j);
      for (int i = 0; i < MOTION; ++i) {
        after[i] = M[k][0][i] * before[0];
        for (int c = 1; c < STATES; ++c) after[i] += M[k][c][i] * before[c];
      }
      for (int a = 0; a < N_INPUTS; ++a) {
        gradient[a] = M[k][0][MOTION + a] * before[0];
        for (int c = 1; c < STATES; ++c) gradient[a] += M[k][c][MOTION + a] * before[c];
        if (own + a >= j && own + a < j + LANES) gradient[a][own + a - j] += 1.0;
      }
      for (int i = 0; k > 0 && i < STATES; ++i) {
        vector sum = i < PLACE ? before[i] : after[i - PLACE];
        for (int a = 0; a < N_INPUTS; ++a) sum -= gain[i][a] * gradient[a];
        *(vector *)(p[i] + j) = sum;
      }
      for (int a = 0; a < N_INPUTS; ++a) {
        for (int b = 0; b < a; ++b) gradient[a] -= L[b][a] * gradient[b];
        *(vector *)(h[a] + j) = gradient[a];
        *(vector *)(scaled[a] + j) = L[a][a] * gradient[a];
      }
    }
    for (int i = own; i < SIZE; ++i)
      for (int j = FROM(i); j < LINE; j += LANES) {
        vector sum = *(vector *)(S[i] + j);
        for (int a = 0; a < N_INPUTS; ++a) sum += scaled[a][i] * *(const vector *)(h[a] + j);
        *(vector *)(S[i] + j) = sum;
      }
  }
}

/* z: of a free input its change, of a held one its multiplier. held: side of every input. */
double z[LINE] __attribute__((aligned(64))), column[LINE] __attribute__((aligned(64)));
double held[SIZE];
int exchanges = 0, sound = 1;
for (int i = 0; i < SIZE; ++i) {
  z[i] = start[i];
  held[i] = 0.0;
  sound = sound && FINITE(start[i]) && FINITE(S[i][i]) && S[i][i] > 0.0;
}
#define BOUND(i) (held[i] > 0.0 ? high[i] : low[i])
#define COLUMN(p) \
  for (int row = 0; row < FROM(p); ++row) column[row] = S[row][p]; \
  for (int row = FROM(p); row < LINE; ++row) column[row] = S[p][row];
/* Exchange p between free and held: the symmetric sweep operator; column holds S's column p, z[p] its new distance. */
#define EXCHANGE(p) \
  { \
    const double inverse = 1.0 / column[p], turned = inverse > 0.0 ? 1.0 : -1.0, moved = z[p] * inverse; \
    for (int row = 0; row < SIZE; ++row) { \
      const double share = column[row] * inverse; \
      for (int j = FROM(row); j < LINE; j += LANES) *(vector *)(S[row] + j) -= share * *(const vector *)(column + j); \
      if (FROM(row) <= (p)) S[row][p] = turned * share; \
      z[row] -= column[row] * moved; \
    } \
    for (int j = FROM(p); j < LINE; ++j) S[p][j] = column[j] * inverse * turned; \
    S[p][p] = -inverse; \
    z[p] = moved * turned; \
    ++exchanges; \
  }
#define HOLD(p, which) \
  { \
    held[p] = which; \
    z[p] -= BOUND(p); \
    sound = sound && column[p] > 0.0; \
    EXCHANGE(p) \
  }
#define RELEASE(p) \
  { \
    sound = sound && column[p] < 0.0; \
    EXCHANGE(p) \
    z[p] += BOUND(p); \
    held[p] = 0.0; \
  }

/* The guess, and what has one value only. */
for (int i = 0; sound && i < SIZE; ++i)
  if (guess[i] != 0.0 || low[i] == high[i]) {
    COLUMN(i)
    HOLD(i, low[i] == high[i] ? 1.0 : guess[i])
  }

double error = huge;
int round = 0, settled = 0;
while (sound && !settled && round < ROUNDS) {
  /* Release what is held with a multiplier of the wrong sign: then the multipliers are feasible. */
  while (sound && exchanges < MOST) {
    int worst = -1;
    double most = 0.0;
    for (int i = 0; i < SIZE; ++i) {
      const double size = -S[i][i];
      if (held[i] != 0.0 && low[i] != high[i] && held[i] * z[i] < -tolerance * size && z[i] * z[i] > most * size) {
        worst = i;
        most = z[i] * z[i] / size;
      }
    }
    if (worst < 0) break;
    COLUMN(worst)
    RELEASE(worst)
  }
  /* Hold what leaves its bounds, the steepest ascent of the dual first; release on the way what would change sign. */
  while (sound && exchanges < MOST) {
    int next = -1;
    double most = 0.0;
    for (int i = 0; i < SIZE; ++i) {
      const double above = z[i] - high[i], below = low[i] - z[i], excess = above > below ? above : below;
      if (held[i] == 0.0 && excess > tolerance && excess * excess > most * S[i][i]) {
        next = i;
        most = excess * excess / S[i][i];
      }
    }
    if (next < 0) break;
    const double which = z[next] > high[next] ? 1.0 : -1.0;
    double pushed = 0.0;
    while (sound && exchanges < MOST) {
      COLUMN(next)
      const double full = (z[next] - (which > 0.0 ? high[next] : low[next])) * which / column[next];
      double length = full;
      int blocking = -1;
      for (int i = 0; i < SIZE; ++i) {
        const double rate = held[i] * which * column[i];
        if (rate > 0.0 && low[i] != high[i] && held[i] * z[i] < length * rate) {
          blocking = i;
          length = held[i] * z[i] > 0.0 ? held[i] * z[i] / rate : 0.0;
        }
      }
      if (blocking < 0) {
        HOLD(next, which)
        z[next] += pushed;
        break;
      }
      for (int i = 0; i < SIZE; ++i) z[i] -= column[i] * length * which;
      pushed += length * which;
      z[blocking] = 0.0;
      COLUMN(blocking)
      RELEASE(blocking)
    }
  }
  /* The states that follow and the true gradient; what it leaves of a Newton step in the free inputs is the error. */
  double gradient[LINE] __attribute__((aligned(64))), state[STATES + N_INPUTS + 1], size = 0.0;
  for (int i = 0; i < STATES; ++i) state[i] = 0.0;
  for (int k = 0; k < NODES; ++k) {
    double *after = dX + k * STATES;
    for (int a = 0, i = k * N_INPUTS; a < N_INPUTS; ++a, ++i) {
      const double d = held[i] != 0.0 ? BOUND(i) : z[i] > high[i] ? high[i] : z[i] < low[i] ? low[i] : z[i];
      state[STATES + a] = dU[i] = d;
    }
    state[STATES + N_INPUTS] = 1.0;
    for (int i = 0; i < STATES; ++i) {
      double sum = i < PLACE ? state[i] : 0.0;
      for (int j = 0; j < AFFINE + 1; ++j) sum += M[k][i][j] * state[PLACE + j];
      after[i] = sum;
    }
    for (int i = 0; i < STATES; ++i) {
      state[i] = after[i];
      size += after[i] > 0.0 ? after[i] : -after[i];
    }
  }
  double multiplier[STATES];
  for (int i = 0; i < STATES; ++i) multiplier[i] = 0.0;
  for (int k = NODES - 1; k >= 0; --k) {
    double both[ROW];
    for (int i = 0; i < STATES; ++i)
      multiplier[i] += q[(k + 1) * STATES + i] + Q[k * STATES + i] * dX[k * STATES + i];
    for (int j = 0; j < ROW; ++j) both[j] = 0.0;
    for (int c = 0; c < STATES; ++c)
      for (int j = 0; j < ROW; ++j) both[j] += M[k][c][j] * multiplier[c];
    for (int i = 0; i < MOTION; ++i) multiplier[PLACE + i] = both[i];
    for (int a = 0, i = k * N_INPUTS; a < N_INPUTS; ++a, ++i) {
      gradient[i] = r[i] + R[i] * dU[i] + both[MOTION + a];
      size += gradient[i] > 0.0 ? gradient[i] : -gradient[i];
    }
  }
  sound = sound && FINITE(size);
  error = 0.0;
  for (int i = 0; i < LINE; ++i) column[i] = 0.0; /* S y, with y the gradient of the free inputs */
  for (int i = 0; i < SIZE; ++i)
    if (held[i] == 0.0) {
      const double y = gradient[i];
      for (int j = 0; j < FROM(i); ++j) column[j] += y * S[j][i];
      for (int j = FROM(i); j < LINE; j += LANES) *(vector *)(column + j) += y * *(const vector *)(S[i] + j);
    }
  settled = 1;
  for (int i = 0; i < SIZE; ++i) {
    double wrong;
    if (held[i] != 0.0) {
      z[i] = -gradient[i] - column[i];
      wrong = low[i] == high[i] ? 0.0 : held[i] * z[i] / S[i][i];
    } else {
      wrong = column[i] > 0.0 ? column[i] : -column[i];
      z[i] = dU[i] - column[i];
    }
    if (wrong > error) error = wrong;
  }
  settled = error <= 10.0 * tolerance;
  ++round;
}
__builtin_free(memory);
sound = sound && FINITE(error);
checks[0] = sound && error <= loose;
checks[1] = exchanges;
for (int i = 0; i < SIZE; ++i) {
  side[i] = held[i];
  checks[2] += held[i] != 0.0;
}
checks[3] = error;
#undef FINITE
#undef FROM
#undef BOUND
#undef COLUMN
#undef EXCHANGE
#undef HOLD
#undef RELEASE
