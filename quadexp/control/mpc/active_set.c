/* The bounded subproblem by a dual active set on the Riccati factorisation, as the body of a compiled function (see
   active_set.py for the method; dual_active_set.py is the second part in numpy, with the same steps in the same order).

   Declared before: N_INPUTS = n, STATES = m, NODES = N; in: rows (of every node, as in riccati_backward.c), K (n, m N), factor
   (n, n N: L below the diagonal, D^-1 on it, of H_k = L D L'), q (m, N + 1), r (n, N), Q (m, N: of the nodes 1..N),
   R (n, N), start, low, high, guess (n, N); out: dX (m, N), dU (n, N), side (n, N), checks (4). All are stored by
   columns: the numbers of one node lie side by side.

   S is symmetric: it is kept in panels of eight columns with the rows down to the diagonal, (8 J + 8, 8) for panel J,
   each row a few vector registers wide. Inputs that pad the last panel have zeros everywhere. */
#if defined(__AVX512F__)
enum { LANES = 8 };
#elif defined(__AVX__)
enum { LANES = 4 };
#else
enum { LANES = 2 };
#endif
typedef double vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
enum { PLACE = 3, MOTION = STATES - PLACE, AFFINE = MOTION + N_INPUTS, ROW = (AFFINE / 8 + 1) * 8 };
enum { SIZE = NODES * N_INPUTS, PANELS = (SIZE + 7) / 8, LINE = 8 * PANELS, MOST = 10 * SIZE, ROUNDS = 4 };
const double tolerance = 1e-10, loose = 1e-7, none = 1e300;

/* An exponent of ones is not a number; -ffast-math lets the compiler believe that there is none. */
#define FINITE(number) (((union { double value; unsigned long long bits; }){number}.bits >> 52 & 0x7ff) != 0x7ff)
#define PANEL(J) (S + 4 * (J) * ((J) + 1)) /* panel J as rows of eight */
#define AT(i, j) PANEL((j) / 8)[i][(j) % 8] /* i up to the last row of j's panel */

const double(*M)[STATES][ROW] = (const double(*)[STATES][ROW])rows;
for (int i = 0; i < 4; ++i) checks[i] = 0.0;
double *memory = __builtin_malloc(sizeof(double) * (32 * PANELS * (PANELS + 1) + 8));
if (!memory) return 0;
double(*S)[8] = (double(*)[8])(((__UINTPTR_TYPE__)memory + 63) / 64 * 64);

/* S = M = H^-1 of the problem in the inputs alone. One backward pass with a unit gradient in every input of every node:
   column j of p and h belongs to input j; M is the sum over the nodes of h' H_k^-1 h. */
{
  double p[STATES][LINE] __attribute__((aligned(64))), h[N_INPUTS][LINE] __attribute__((aligned(64)));
  double scaled[N_INPUTS][LINE] __attribute__((aligned(64)));
  for (int i = 0; i < STATES; ++i)
    for (int j = 0; j < LINE; ++j) p[i][j] = 0.0;
  for (int i = 0; i < 4 * PANELS * (PANELS + 1); ++i)
    for (int j = 0; j < 8; ++j) S[i][j] = 0.0;
  for (int k = NODES - 1; k >= 0; --k) {
    const double(*gain)[N_INPUTS] = (const double(*)[N_INPUTS])(K + k * STATES * N_INPUTS);
    const double(*L)[N_INPUTS] = (const double(*)[N_INPUTS])(factor + k * N_INPUTS * N_INPUTS);
    const int own = k * N_INPUTS;
    for (int j = own / 8 * 8; j < LINE; j += LANES) {
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
    for (int J = own / 8; J < PANELS; ++J)
      for (int part = 0; part < 8; part += LANES) {
        vector line[N_INPUTS];
        for (int a = 0; a < N_INPUTS; ++a) line[a] = *(const vector *)(h[a] + 8 * J + part);
        for (int i = own / 8 * 8; i < 8 * J + 8; ++i) {
          vector sum = *(vector *)(PANEL(J)[i] + part);
          for (int a = 0; a < N_INPUTS; ++a) sum += scaled[a][i] * line[a];
          *(vector *)(PANEL(J)[i] + part) = sum;
        }
      }
  }
}

/* z: of a free input its change, of a held one its multiplier. held: side of every input, 0 free. bottom, top: bounds
   of the free ones; nothing leaves those of the others. */
double z[LINE] __attribute__((aligned(64))), column[LINE] __attribute__((aligned(64)));
double share[LINE] __attribute__((aligned(64))), held[LINE], bottom[LINE], top[LINE];
int sound = 1;
for (int i = 0; i < LINE; ++i) {
  const int inside = i < SIZE;
  z[i] = inside ? start[i] : 0.0;
  bottom[i] = inside ? low[i] : -none;
  top[i] = inside ? high[i] : none;
  held[i] = 0.0;
  if (inside) sound = sound && FINITE(start[i]) && FINITE(AT(i, i)) && AT(i, i) > 0.0;
}

double error = none, which = 0.0, pushed = 0.0;
int exchanges = 0, guessed = 0, feasible = 0, next = -1, rounds = 0;
while (sound) {
  int p = -1; /* to be exchanged: to the side `onto`, or where that is 0 to be free */
  double onto = 0.0;
  /* First the guess, and what has one value only. */
  for (; p < 0 && guessed < SIZE; ++guessed)
    if (guess[guessed] != 0.0 || low[guessed] == high[guessed]) {
      p = guessed;
      onto = low[p] == high[p] ? 1.0 : guess[p];
    }
  if (exchanges < MOST) {
    /* Then what is held with a multiplier of the wrong sign is released, the steepest first. */
    if (p < 0 && !feasible) {
      double most = 0.0;
      for (int i = 0; i < SIZE; ++i)
        if (held[i] * z[i] < 0.0) {
          const double size = -AT(i, i);
          if (low[i] != high[i] && held[i] * z[i] < -tolerance * size && z[i] * z[i] > most * size) {
            p = i;
            most = z[i] * z[i] / size;
          }
        }
      feasible = p < 0;
    }
    /* Then what leaves its bounds is held, the steepest ascent of the dual cost first; */
    if (p < 0 && next < 0) {
      double most = 0.0;
      for (int i = 0; i < SIZE; ++i) {
        const double above = z[i] - top[i], below = bottom[i] - z[i], excess = above > below ? above : below;
        if (excess > tolerance && excess * excess > most * AT(i, i)) {
          next = i;
          most = excess * excess / AT(i, i);
        }
      }
      which = next >= 0 && z[next] > top[next] ? 1.0 : -1.0;
      pushed = 0.0;
    }
  }
#define COLUMN(p) \
  for (int i = 0; i < (p) / 8 * 8 + 8; ++i) column[i] = AT(i, p); \
  for (int J = (p) / 8 + 1; J < PANELS; ++J) \
    for (int i = 0; i < 8; ++i) column[8 * J + i] = PANEL(J)[p][i];
  /* what would get a multiplier of the wrong sign before it arrives there is released on the way. */
  if (p < 0 && next >= 0) {
    COLUMN(next)
    p = next;
    onto = which;
    double length = (z[next] - (which > 0.0 ? top[next] : bottom[next])) * which / column[next];
    for (int i = 0; i < SIZE; ++i)
      if (held[i] * z[i] < length * (held[i] * which * column[i])) {
        const double rate = held[i] * which * column[i];
        if (rate > 0.0 && low[i] != high[i]) {
          p = i;
          onto = 0.0;
          length = held[i] * z[i] > 0.0 ? held[i] * z[i] / rate : 0.0;
        }
      }
    if (p != next) {
      for (int i = 0; i < LINE; ++i) z[i] -= column[i] * length * which;
      pushed += length * which;
      z[p] = 0.0;
      COLUMN(p)
    }
  } else if (p >= 0) {
    COLUMN(p)
  }

  if (p >= 0) {
    /* The symmetric sweep operator on p. */
    if (onto != 0.0) z[p] -= onto > 0.0 ? high[p] : low[p];
    sound = onto != 0.0 ? column[p] > 0.0 : column[p] < 0.0;
    const double inverse = 1.0 / column[p], turned = onto != 0.0 ? 1.0 : -1.0, moved = z[p] * inverse;
    for (int i = 0; i < LINE; ++i) {
      share[i] = column[i] * inverse;
      z[i] -= column[i] * moved;
    }
    for (int J = 0; J < PANELS; ++J)
      for (int part = 0; part < 8; part += LANES) {
        const vector line = *(const vector *)(column + 8 * J + part);
#pragma GCC unroll 8
        for (int i = 0; i < 8 * J + 8; ++i) *(vector *)(PANEL(J)[i] + part) -= share[i] * line;
      }
    for (int i = 0; i < p / 8 * 8 + 8; ++i) AT(i, p) = turned * share[i];
    for (int i = p / 8 * 8; i < LINE; ++i) AT(p, i) = turned * share[i];
    AT(p, p) = -inverse;
    z[p] = turned * moved;
    if (onto != 0.0) {
      if (p == next) {
        z[p] += pushed;
        next = -1;
      }
      bottom[p] = -none;
      top[p] = none;
    } else {
      bottom[p] = low[p];
      top[p] = high[p];
      z[p] += held[p] > 0.0 ? high[p] : low[p];
    }
    held[p] = onto;
    ++exchanges;
    continue;
  }

  /* Nothing is left to exchange: the states that follow, and the true gradient, which is zero in the free inputs. */
  double gradient[LINE], state[STATES], size = 0.0;
  for (int i = 0; i < STATES; ++i) state[i] = 0.0;
  for (int k = 0; k < NODES; ++k) {
    double moving[ROW]; /* as a row of M: motion, inputs, 1 */
    for (int i = 0; i < MOTION; ++i) moving[i] = state[PLACE + i];
    for (int a = 0, i = k * N_INPUTS; a < N_INPUTS; ++a, ++i) {
      const double inside = z[i] > high[i] ? high[i] : z[i] < low[i] ? low[i] : z[i];
      moving[MOTION + a] = dU[i] = held[i] > 0.0 ? high[i] : held[i] < 0.0 ? low[i] : inside;
    }
    for (int j = AFFINE; j < ROW; ++j) moving[j] = j == AFFINE;
    for (int i = 0; i < STATES; ++i) {
      double sum = i < PLACE ? state[i] : 0.0;
      for (int j = 0; j < ROW; ++j) sum += M[k][i][j] * moving[j];
      dX[k * STATES + i] = sum;
    }
    for (int i = 0; i < STATES; ++i) {
      state[i] = dX[k * STATES + i];
      size += state[i] * state[i];
    }
  }
  for (int i = 0; i < STATES; ++i) state[i] = 0.0; /* from here the multipliers of the dynamics */
  for (int k = NODES - 1; k >= 0; --k) {
    double both[ROW];
    vector sums[ROW / LANES];
    for (int j = 0; j < ROW / LANES; ++j) sums[j] = (vector){0};
    for (int i = 0; i < STATES; ++i) {
      state[i] += q[(k + 1) * STATES + i] + Q[k * STATES + i] * dX[k * STATES + i];
      for (int j = 0; j < ROW / LANES; ++j) sums[j] += state[i] * *(const vector *)(M[k][i] + j * LANES);
    }
    for (int j = 0; j < ROW / LANES; ++j) *(vector *)(both + j * LANES) = sums[j];
    for (int i = 0; i < MOTION; ++i) state[PLACE + i] = both[i];
    for (int a = 0, i = k * N_INPUTS; a < N_INPUTS; ++a, ++i) {
      gradient[i] = r[i] + R[i] * dU[i] + both[MOTION + a];
      size += gradient[i] * gradient[i];
    }
  }
  /* One Newton step, S y of the free inputs' gradient y: what it would still change is the error. */
  for (int i = 0; i < LINE; ++i) {
    share[i] = i < SIZE && held[i] == 0.0 ? gradient[i] : 0.0;
    column[i] = 0.0;
  }
  for (int J = 0; J < PANELS; ++J)
    for (int i = 0; i < 8 * J + 8; ++i) {
      double across = 0.0;
      for (int j = 0; j < 8; ++j) {
        column[8 * J + j] += share[i] * PANEL(J)[i][j];
        across += PANEL(J)[i][j] * share[8 * J + j];
      }
      if (i < 8 * J) column[i] += across;
    }
  error = 0.0;
  for (int i = 0; i < SIZE; ++i) {
    double left = column[i] > 0.0 ? column[i] : -column[i];
    z[i] = dU[i] - column[i];
    if (held[i] != 0.0) {
      z[i] = -gradient[i] - column[i];
      left = low[i] == high[i] ? 0.0 : held[i] * z[i] / AT(i, i);
    }
    if (left > error) error = left;
    size += left * left;
  }
  sound = FINITE(size);
  if (error <= 10.0 * tolerance || ++rounds == ROUNDS) break;
  feasible = 0;
}
__builtin_free(memory);
checks[0] = sound && error <= loose;
checks[1] = exchanges;
for (int i = 0; i < SIZE; ++i) {
  side[i] = held[i];
  checks[2] += held[i] != 0.0;
}
checks[3] = error;
#undef FINITE
#undef PANEL
#undef AT
#undef COLUMN
