"""Where the sonar really was: micronavigation and autofocus."""
