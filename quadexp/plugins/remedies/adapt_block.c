/* One update of the weights of one component (quadexp/plugins/remedies/online.py), as the body of a compiled function.

   Declared before: SIZE = h, RLS, FITC, COMPOSITE (0 or 1); in: belief (b, then P by columns), row (regressors of the
   weights), root (h, h; by columns), mean (h), sample, variance, decay, signal (variance of the function a priori),
   push (dt c sigma); out: next (as belief), weights (h), innovation. Matrices are symmetric: one triangle decides. */
const double *b = belief, *P = belief + SIZE;
double phi[SIZE], spread[SIZE], gain[SIZE], *new_b = next, *new_P = next + SIZE;
for (int j = 0; j < SIZE; ++j) {
  double sum = 0.0;
  for (int i = 0; i < SIZE; ++i) sum += row[i] * root[j * SIZE + i];
  phi[j] = sum;
}
const double fall = decay[0];
double keep = fall * fall, added = 1.0 - fall * fall;
if (RLS) {
  double trace = 0.0;
  for (int i = 0; i < SIZE; ++i) trace += P[i * SIZE + i];
  const double most = SIZE / trace > 1.0 ? SIZE / trace : 1.0;
  keep = 1.0 / fall < most ? 1.0 / fall : most;
  added = 0.0;
}
for (int i = 0; i < SIZE; ++i) {
  new_b[i] = (RLS ? 1.0 : fall) * b[i];
  spread[i] = added * phi[i];
}
for (int j = 0; j < SIZE; ++j)
  for (int i = 0; i < SIZE; ++i) spread[i] += keep * P[j * SIZE + i] * phi[j];
double known = 0.0, length = 0.0, error = sample[0];
for (int i = 0; i < SIZE; ++i) {
  known += phi[i] * spread[i];
  length += phi[i] * phi[i];
  error -= phi[i] * new_b[i];
}
double noise = variance[0];
if (FITC && signal[0] > length) noise += signal[0] - length;
const double s = known + noise;
for (int i = 0; i < SIZE; ++i) {
  gain[i] = spread[i] / s;
  new_b[i] += gain[i] * error;
}
for (int j = 0; j < SIZE; ++j) {
  const double g = gain[j], p = spread[j], sg = s * gain[j];
  for (int i = 0; i < SIZE; ++i)
    new_P[j * SIZE + i] = keep * P[j * SIZE + i] - gain[i] * p - spread[i] * g + sg * gain[i];
  new_P[j * SIZE + j] += added;
}
for (int j = 0; j < SIZE; ++j)
  for (int i = j + 1; i < SIZE; ++i) new_P[i * SIZE + j] = new_P[j * SIZE + i];
if (COMPOSITE)
  for (int j = 0; j < SIZE; ++j) {
    double sum = 0.0;
    for (int i = 0; i < SIZE; ++i) sum += new_P[j * SIZE + i] * phi[i];
    new_b[j] += push[0] * sum;
  }
for (int i = 0; i < SIZE; ++i) weights[i] = mean[i];
for (int j = 0; j < SIZE; ++j)
  for (int i = 0; i < SIZE; ++i) weights[i] += root[j * SIZE + i] * new_b[j];
innovation[0] = error;
