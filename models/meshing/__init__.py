"""Any surface, or a segmented volume, made into the even, closed mesh of an organ."""
