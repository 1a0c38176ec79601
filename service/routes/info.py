"""What the service is and can."""

from fastapi import APIRouter

import smsr
from service.context import Shared
from service.paging import PAGE_SIZE
from service.schemas import option_document
from service.waiting import MAX_WAIT_SECONDS
from smsr.files import SUFFIXES
from smsr.options import describe
from smsr_client.documents import Formats, Info, Limits
from worker.options import JobOptions

router = APIRouter(prefix="/v1", tags=["service"])


@router.get("/info", summary="Version, limits, formats and options")
async def get_info(shared: Shared) -> Info:
    """Return all that a form or a client needs to know before it submits."""
    settings = shared.settings
    arrays = [suffix.removeprefix(".") for suffix in SUFFIXES]
    return Info(
        version=smsr.__version__,
        limits=Limits(
            upload_bytes=settings.max_upload_bytes,
            array_bytes=settings.max_array_bytes,
            job_seconds=settings.job_timeout_seconds,
            result_ttl_seconds=settings.result_ttl_seconds,
            wait_seconds=MAX_WAIT_SECONDS,
            page_size=PAGE_SIZE,
        ),
        formats=Formats(
            measurements=arrays,
            ground_truth=arrays,
            faces=arrays,
            results=["npz", "ply", "glb", "json"],
        ),
        options=[option_document(option) for option in describe(JobOptions)],
    )
