/* Sums over the M inducing points of one Gaussian process with D scaled features, as the body of a compiled function:

       value = sum_j w_j,   slope_i = sum_j w_j d_ij,     w_j = alpha_j exp(-sum_i d_ij^2),   d_ij = feature_i - points_ij

   Declared before: POINTS = M, FEATURES = D; in: feature (D), points (D, M), alpha (M); out: value, slope (D). */
double weight[POINTS];
for (int j = 0; j < POINTS; ++j) weight[j] = 0.0;
for (int i = 0; i < FEATURES; ++i)
  for (int j = 0; j < POINTS; ++j) {
    const double d = feature[i] - points[i * POINTS + j];
    weight[j] -= d * d;
  }
double sum = 0.0;
for (int j = 0; j < POINTS; ++j) sum += weight[j] = alpha[j] * exp(weight[j]);
value[0] = sum;
for (int i = 0; i < FEATURES; ++i) {
  sum = 0.0;
  for (int j = 0; j < POINTS; ++j) sum += weight[j] * (feature[i] - points[i * POINTS + j]);
  slope[i] = sum;
}
