"""The mapping core: pure stages and the values between them."""
