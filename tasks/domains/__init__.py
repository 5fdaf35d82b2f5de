"""The exercises, a file each: state of a world, random draws, rules, expert and texts."""
