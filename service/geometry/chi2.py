"""What chance explains of squared sigmas, by degrees of freedom."""

CHI2_99_OF_1, CHI2_999_OF_1 = 6.6, 10.8  # 99 and 99.9 % of one degree of freedom
CHI2_99_OF_2 = 9.21
CHI2_99_OF_3, CHI2_999_OF_3, CHI2_99999_OF_3, CHI2_MEDIAN_OF_3 = 11.3, 16.3, 27.9, 2.37
