"""The database that the settings ask for; what is wrong with it, in a sentence."""

from collections.abc import Callable

from sqlalchemy.exc import DBAPIError

from service.errors import RequestError
from service.server.settings import Settings
from service.server.store.database import Database, DatabaseError, connect


def open_database(settings: Settings, prepare: Callable[[Settings, Database], None]) -> Database:
    """Open the database.

    Args:
        settings: of the service.
        prepare: makes the tables that are needed, or looks whether they are there.

    Raises:
        RequestError: the data folder or the database cannot be used.
    """
    try:
        database = connect(settings.sqlalchemy_url)
        prepare(settings, database)
    except DatabaseError as error:
        raise RequestError(str(error)) from error
    except OSError as error:
        raise RequestError(f"data {settings.data}: the folder cannot be used ({error.strerror})") from None
    except DBAPIError as error:
        what = f"data {settings.data}: the database in it" if settings.is_sqlite else "database_url: the database"
        raise RequestError(f"{what} cannot be used ({' '.join(str(error.orig).split())})") from None
    return database
