/* Gradient of a network's outputs through one layer, as the body of a compiled function:

       product = gradient diag(slope) weight

   Declared before: OUTPUTS, ROWS, COLUMNS; in: gradient (OUTPUTS, ROWS), slope (ROWS), weight (ROWS, COLUMNS); out:
   product (OUTPUTS, COLUMNS); matrices by columns. */
casadi_real through[OUTPUTS][ROWS];
for (int k = 0; k < OUTPUTS; ++k)
  for (int i = 0; i < ROWS; ++i) through[k][i] = gradient[i * OUTPUTS + k] * slope[i];
for (int j = 0; j < COLUMNS; ++j)
  for (int k = 0; k < OUTPUTS; ++k) {
    casadi_real sum = 0.0;
    for (int i = 0; i < ROWS; ++i) sum += through[k][i] * weight[j * ROWS + i];
    product[j * OUTPUTS + k] = sum;
  }
