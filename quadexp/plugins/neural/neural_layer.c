/* One layer of a network, as the body of a compiled function:

       value = s(weight x + bias),   slope = s'(weight x + bias),   s(t) = t / sqrt(1 + t^2)

   Declared before: ROWS, COLUMNS; in: weight (ROWS, COLUMNS; by columns), bias, x; out: value, slope (ROWS). */
casadi_real sum[ROWS];
for (int i = 0; i < ROWS; ++i) sum[i] = bias[i];
for (int j = 0; j < COLUMNS; ++j)
  for (int i = 0; i < ROWS; ++i) sum[i] += weight[j * ROWS + i] * x[j];
for (int i = 0; i < ROWS; ++i) {
  const casadi_real q = 1.0 / sqrt(1.0 + sum[i] * sum[i]);
  value[i] = sum[i] * q;
  slope[i] = q * q * q;
}
