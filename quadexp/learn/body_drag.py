"""Drag along the body's axes, of the air-relative body velocity v (m/s); the coefficients stand for 1/s and 1/m.

    linear       a_i = -d_i v_i + b_i                            Faessler et al. 2018
    quadratic    a_i = -d_i v_i - e_i v_i |v_i| + b_i

The intercepts b_x, b_y hold the accelerometer's bias and the trim (an off-axis centre of mass, a bent rotor): without
them a bias times a mean velocity goes into d. Along z the thrust has that part: the thrust curve's own columns are
fitted beside d_z (see thrust_curve), and beside the quadratic pair the curve's scale is, as the term `thrust`.
"""

LINEAR = (("linear", "offset"), ("linear", "offset"), ("linear",))
QUADRATIC = (("linear", "quadratic", "offset"), ("linear", "quadratic", "offset"), ("thrust", "linear", "quadratic"))
