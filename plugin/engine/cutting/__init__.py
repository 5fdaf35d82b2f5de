"""What comes apart in one mjData: organs that are cut, tools that cut, tissue that tears."""
