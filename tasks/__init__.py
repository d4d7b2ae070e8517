"""One retriable unit of work each: open the inputs, call worldpose, publish the result."""
