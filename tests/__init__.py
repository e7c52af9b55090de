import gc

# A third of the time of importing all that the tests import is the search for garbage, of which there is none;
# conftest.py enables it when tests begin.
gc.disable()
