/* One node of the backward Riccati recursion, as the body of a compiled function (see riccati.py for the equations).

   Declared before: N_INPUTS = n, STATES = m; in: cost, rows, q (m), r (n), Q (m), R (n); out: cost_next, K, k (n), factor, each
   null where it is not asked for. K (n, m) and factor (n, n: L below the diagonal, D^-1 on it) are stored by columns,
   all else by rows. A row is a few vector registers wide:

       LINE          motion s (m - 3) | inputs u (n) | affine (1) | padding
       rows          (m, LINE)               M, x_next = p + M [s, u, 1]: [A, B, b] less A's first columns, [I; 0]
       cost          (m, LINE), (3, 3)       P's columns of s, with p in the affine column; then P's block of positions

   With S = [A B b]' P [A B b] + costs the inputs are eliminated by S_uu = L D L', Y = L^-1 S_u: the cost to go of this
   node is S - Y' D^-1 Y, and its gains are L^-T D^-1 Y. What cost holds in the columns of u and beyond is never read. */
#if defined(__AVX512F__)
enum { LANES = 8 };
#elif defined(__AVX__)
enum { LANES = 4 };
#else
enum { LANES = 2 };
#endif
typedef double vector __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
enum { PLACE = 3, MOTION = STATES - PLACE, AFFINE = MOTION + N_INPUTS, LINE = (AFFINE / 8 + 1) * 8 };

const double(*P)[LINE] = (const double(*)[LINE])cost, (*M)[LINE] = (const double(*)[LINE])rows;
const double(*P_place)[PLACE] = (const double(*)[PLACE])(cost + STATES * LINE);
double W[STATES][LINE], S[AFFINE][LINE], place[N_INPUTS][PLACE];
double L[N_INPUTS][N_INPUTS], inverse[N_INPUTS], G[N_INPUTS][LINE], G_place[N_INPUTS][PLACE];

/* W = P [A B b], with p in the affine column. */
for (int i = 0; i < STATES; ++i)
  for (int j = 0; j < LINE; j += LANES) {
    vector sum = {0};
    for (int c = 0; c < PLACE; ++c) sum += (i < PLACE ? P_place[i][c] : P[c][i - PLACE]) * *(const vector *)(M[c] + j);
    for (int c = 0; c < MOTION; ++c) sum += P[i][c] * *(const vector *)(M[PLACE + c] + j);
    *(vector *)(W[i] + j) = sum;
  }
for (int i = 0; i < STATES; ++i) W[i][AFFINE] += P[i][AFFINE];

/* S = [A B]' W plus the costs; its rows of positions are W's. */
for (int i = 0; i < AFFINE; ++i)
  for (int j = 0; j < LINE; j += LANES) {
    vector sum = {0};
    for (int c = 0; c < STATES; ++c) sum += M[c][i] * *(const vector *)(W[c] + j);
    *(vector *)(S[i] + j) = sum;
  }
for (int i = 0; i < PLACE; ++i) W[i][AFFINE] += q[i];
for (int i = 0; i < MOTION; ++i) {
  S[i][i] += Q[PLACE + i];
  S[i][AFFINE] += q[PLACE + i];
}

/* S_uu = L D L', Y = L^-1 S_u in the last rows of S. */
double(*Y)[LINE] = S + MOTION;
for (int a = 0; a < N_INPUTS; ++a) {
  Y[a][MOTION + a] += R[a];
  Y[a][AFFINE] += r[a];
  for (int i = 0; i < PLACE; ++i) place[a][i] = W[i][MOTION + a];
  for (int b = 0; b < a; ++b) {
    const double share = L[a][b] = inverse[b] * Y[b][MOTION + a];
    for (int j = 0; j < LINE; j += LANES) *(vector *)(Y[a] + j) -= share * *(vector *)(Y[b] + j);
    for (int i = 0; i < PLACE; ++i) place[a][i] -= share * place[b][i];
  }
  inverse[a] = 1.0 / Y[a][MOTION + a];
}

/* Gains L^-T D^-1 Y. */
for (int a = N_INPUTS - 1; a >= 0; --a) {
  for (int j = 0; j < LINE; j += LANES) {
    vector sum = inverse[a] * *(vector *)(Y[a] + j);
    for (int b = a + 1; b < N_INPUTS; ++b) sum -= L[b][a] * *(vector *)(G[b] + j);
    *(vector *)(G[a] + j) = sum;
  }
  for (int i = 0; i < PLACE; ++i) {
    double sum = inverse[a] * place[a][i];
    for (int b = a + 1; b < N_INPUTS; ++b) sum -= L[b][a] * G_place[b][i];
    G_place[a][i] = sum;
  }
}
for (int a = 0; a < N_INPUTS; ++a) {
  if (k) k[a] = G[a][AFFINE];
  for (int i = 0; K && i < STATES; ++i) K[i * N_INPUTS + a] = i < PLACE ? G_place[a][i] : G[a][i - PLACE];
  for (int b = 0; factor && b < N_INPUTS; ++b) factor[b * N_INPUTS + a] = b < a ? L[a][b] : b > a ? 0.0 : inverse[a];
}
if (!cost_next) return 0;

/* S - Y' D^-1 Y = S - S_xu K. */
double(*P_next)[LINE] = (double(*)[LINE])cost_next, (*P_place_next)[PLACE] = (double(*)[PLACE])(cost_next + STATES * LINE);
for (int i = 0; i < STATES; ++i) {
  double share[N_INPUTS];
  for (int a = 0; a < N_INPUTS; ++a) share[a] = inverse[a] * (i < PLACE ? place[a][i] : Y[a][i - PLACE]);
  for (int j = 0; j < LINE; j += LANES) {
    vector sum = *(const vector *)((i < PLACE ? W[i] : S[i - PLACE]) + j);
    for (int a = 0; a < N_INPUTS; ++a) sum -= share[a] * *(vector *)(Y[a] + j);
    *(vector *)(P_next[i] + j) = sum;
  }
  for (int j = 0; i < PLACE && j < PLACE; ++j) {
    double sum = P_place[i][j] + (i == j ? Q[i] : 0.0);
    for (int a = 0; a < N_INPUTS; ++a) sum -= share[a] * place[a][j];
    P_place_next[i][j] = sum;
  }
}
