/* One node of the backward Riccati recursion for processors without vector registers, included by stages.c where SCALAR
   is defined: the numbers of riccati_backward.c, which has the equations and the layout, in another order of summation.

   Products go over two rows and BLOCK columns at a time, whose sums stay in registers; of the symmetric S only the upper
   triangle is computed. The last block of a row ends with it, and computes again what it shares with the one before. */
enum { ROW = AFFINE + 1, BLOCK_COLUMNS = 5 };

static inline int block(int column) { return column + BLOCK_COLUMNS > ROW ? ROW - BLOCK_COLUMNS : column; }

/* first, second (BLOCK_COLUMNS each) = sums over c of left[c] and right[c] times the row c of `rows`, which are `step`
   apart. */
static inline void two_rows(const real *left, const real *right, integer across, const real *rows, integer step,
                            real *first, real *second) {
  real a0 = 0, a1 = 0, a2 = 0, a3 = 0, a4 = 0, b0 = 0, b1 = 0, b2 = 0, b3 = 0, b4 = 0;
  for (int c = 0; c < STATES; ++c) {
    const real x = *left, y = *right;
    const real m0 = rows[0], m1 = rows[1], m2 = rows[2], m3 = rows[3], m4 = rows[4];
    a0 += x * m0, a1 += x * m1, a2 += x * m2, a3 += x * m3, a4 += x * m4;
    b0 += y * m0, b1 += y * m1, b2 += y * m2, b3 += y * m3, b4 += y * m4;
    left += across, right += across, rows += step;
  }
  first[0] = a0, first[1] = a1, first[2] = a2, first[3] = a3, first[4] = a4;
  second[0] = b0, second[1] = b1, second[2] = b2, second[3] = b3, second[4] = b4;
}

static void riccati(const real *restrict cost, const real *restrict rows, const real *restrict q,
                    const real *restrict r, const real *restrict Q, const real *restrict R, real *restrict cost_next,
                    real *restrict K, real *restrict k, real *restrict factor) {
  const real(*P)[LINE] = (const real(*)[LINE])cost, (*M)[LINE] = (const real(*)[LINE])rows;
  const real(*P_place)[PLACE] = (const real(*)[PLACE])(cost + STATES * LINE);
  real full[STATES + 1][STATES], W[STATES + 1][ROW], S[AFFINE + 1][ROW], place[N_INPUTS][PLACE];
  real L[N_INPUTS][N_INPUTS], inverse[N_INPUTS], G[N_INPUTS][ROW], G_place[N_INPUTS][PLACE];

  /* W = P [A B b], with p in the affine column; the last row of full is only there to be read. */
  for (int i = 0; i < PLACE; ++i)
    for (int c = 0; c < PLACE; ++c) full[i][c] = P_place[i][c];
  for (int i = PLACE; i < STATES; ++i)
    for (int c = 0; c < PLACE; ++c) full[i][c] = P[c][i - PLACE];
  for (int i = 0; i < STATES; ++i) __builtin_memcpy(full[i] + PLACE, P[i], sizeof(real) * MOTION);
  __builtin_memcpy(full[STATES], full[0], sizeof full[0]);
  for (int i = 0; i < STATES; i += 2)
    for (int j = 0; j < ROW; j += BLOCK_COLUMNS) {
      const int at = block(j);
      two_rows(full[i], full[i + 1], 1, M[0] + at, LINE, W[i] + at, W[i + 1] + at);
    }
  for (int i = 0; i < STATES; ++i) W[i][AFFINE] += P[i][AFFINE];

  /* S = [A B]' W plus the costs, from its diagonal on; its rows of positions are W's. */
  for (int i = 0; i < AFFINE; i += 2)
    for (int j = i / BLOCK_COLUMNS * BLOCK_COLUMNS; j < ROW; j += BLOCK_COLUMNS) {
      const int at = block(j);
      two_rows(M[0] + i, M[0] + i + 1, LINE, W[0] + at, ROW, S[i] + at, S[i + 1] + at);
    }
  for (int i = 0; i < PLACE; ++i) W[i][AFFINE] += q[i];
  for (int i = 0; i < MOTION; ++i) {
    S[i][i] += Q[PLACE + i];
    S[i][AFFINE] += q[PLACE + i];
  }

  /* S_uu = L D L', Y = L^-1 S_u in the last rows of S; its columns of motion are the other triangle's. */
  real(*Y)[ROW] = S + MOTION;
  for (int a = 0; a < N_INPUTS; ++a) {
    for (int j = 0; j < MOTION; ++j) Y[a][j] = S[j][MOTION + a];
    for (int b = 0; b < a; ++b) Y[a][MOTION + b] = 0;
    Y[a][MOTION + a] += R[a];
    Y[a][AFFINE] += r[a];
    for (int i = 0; i < PLACE; ++i) place[a][i] = W[i][MOTION + a];
    for (int b = 0; b < a; ++b) {
      const real share = L[a][b] = inverse[b] * Y[b][MOTION + a];
      for (int j = 0; j < MOTION; ++j) Y[a][j] -= share * Y[b][j];
      for (int j = MOTION + a; j <= AFFINE; ++j) Y[a][j] -= share * Y[b][j];
      for (int i = 0; i < PLACE; ++i) place[a][i] -= share * place[b][i];
    }
    inverse[a] = 1 / Y[a][MOTION + a];
  }

  /* Gains L^-T D^-1 Y. */
  for (int a = N_INPUTS - 1; a >= 0; --a) {
    for (int j = 0; j < ROW; j = j == MOTION - 1 ? AFFINE : j + 1) {
      real sum = inverse[a] * Y[a][j];
      for (int b = a + 1; b < N_INPUTS; ++b) sum -= L[b][a] * G[b][j];
      G[a][j] = sum;
    }
    for (int i = 0; i < PLACE; ++i) {
      real sum = inverse[a] * place[a][i];
      for (int b = a + 1; b < N_INPUTS; ++b) sum -= L[b][a] * G_place[b][i];
      G_place[a][i] = sum;
    }
  }
  for (int a = 0; a < N_INPUTS; ++a) {
    k[a] = G[a][AFFINE];
    for (int i = 0; K && i < STATES; ++i) K[i * N_INPUTS + a] = i < PLACE ? G_place[a][i] : G[a][i - PLACE];
    for (int b = 0; b < N_INPUTS; ++b) factor[b * N_INPUTS + a] = b < a ? L[a][b] : b > a ? 0 : inverse[a];
  }
  if (!cost_next) return;

  /* S - Y' D^-1 Y = S - S_xu K, and the other triangle. */
  real(*P_next)[LINE] = (real(*)[LINE])cost_next, (*P_place_next)[PLACE] = (real(*)[PLACE])(cost_next + STATES * LINE);
  for (int i = 0; i < STATES; ++i) {
    real share[N_INPUTS];
    for (int a = 0; a < N_INPUTS; ++a) share[a] = inverse[a] * (i < PLACE ? place[a][i] : Y[a][i - PLACE]);
    const real *from = i < PLACE ? W[i] : S[i - PLACE];
    for (int j = i < PLACE ? 0 : i - PLACE; j < ROW; j = j == MOTION - 1 ? AFFINE : j + 1) {
      real sum = from[j];
      for (int a = 0; a < N_INPUTS; ++a) sum -= share[a] * Y[a][j];
      P_next[i][j] = sum;
      if (i >= PLACE && j < MOTION) P_next[PLACE + j][i - PLACE] = sum;
    }
    for (int j = 0; i < PLACE && j < PLACE; ++j) {
      real sum = P_place[i][j] + (i == j ? Q[i] : 0);
      for (int a = 0; a < N_INPUTS; ++a) sum -= share[a] * place[a][j];
      P_place_next[i][j] = sum;
    }
  }
}
