"""The client library: what a program needs to talk to a daemon, blocking or with asyncio.

References: own.
"""

from hmt_service.client.asynchronous import AsyncHmtClient, AsyncLive
from hmt_service.client.blocking import HmtClient, Live

__all__ = ["AsyncHmtClient", "AsyncLive", "HmtClient", "Live"]
