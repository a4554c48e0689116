/* Sums over the M inducing points of one Gaussian process with D scaled features, as the body of a compiled function:

       value = sum_j w_j,   slope_i = sum_j w_j d_ij,     w_j = alpha_j exp(-sum_i d_ij^2),   d_ij = feature_i - points_ij

   and with FACTOR = M, 0 for neither, of the variance that the points explain,

       known = ||F e||^2,   known_slope_i = (F e)' F (e d_i),     e_j = exp(-sum_i d_ij^2)

   Declared before: POINTS = M, FEATURES = D; in: feature (D), points (D, M), alpha (M), factor (FACTOR, M) by columns,
   upper triangular; out: value, slope (D), known, known_slope (D). */
casadi_real weight[POINTS], explained[POINTS];
for (int j = 0; j < POINTS; ++j) weight[j] = 0.0;
for (int i = 0; i < FEATURES; ++i)
  for (int j = 0; j < POINTS; ++j) {
    const casadi_real d = feature[i] - points[i * POINTS + j];
    weight[j] -= d * d;
  }
casadi_real sum = 0.0;
for (int j = 0; j < POINTS; ++j) {
  explained[j] = exp(weight[j]);
  sum += weight[j] = alpha[j] * explained[j];
}
value[0] = sum;
if (FACTOR) {
  casadi_real root[POINTS] = {0.0}, turn[FEATURES][POINTS] = {{0.0}};
  for (int j = 0; j < POINTS; ++j) {
    for (int r = 0; r < POINTS; ++r) root[r] += factor[j * POINTS + r] * explained[j];
    for (int i = 0; i < FEATURES; ++i) {
      const casadi_real moved = explained[j] * (feature[i] - points[i * POINTS + j]);
      for (int r = 0; r < POINTS; ++r) turn[i][r] += factor[j * POINTS + r] * moved;
    }
  }
  known[0] = 0.0;
  for (int r = 0; r < POINTS; ++r) known[0] += root[r] * root[r];
  for (int i = 0; i < FEATURES; ++i) {
    known_slope[i] = 0.0;
    for (int r = 0; r < POINTS; ++r) known_slope[i] += root[r] * turn[i][r];
  }
}
for (int i = 0; i < FEATURES; ++i) {
  sum = 0.0;
  for (int j = 0; j < POINTS; ++j) sum += weight[j] * (feature[i] - points[i * POINTS + j]);
  slope[i] = sum;
}
