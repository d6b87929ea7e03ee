"""What chance explains of squared sigmas, by degrees of freedom."""

CHI2_999_OF_1 = 10.8  # 99.9 % of one degree of freedom
CHI2_99_OF_3, CHI2_999_OF_3 = 11.3, 16.3  # 99 and 99.9 % of three
