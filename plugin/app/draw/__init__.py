"""Pictures, films and MuJoCo's viewer."""
