"""auto_LiRPA, the reference to compare with."""
