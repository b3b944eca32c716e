"""A stage that is not there: it receives what is sent to lamps, and shows what a camera would see."""
