"""Responses of the HTTP API as frozen Pydantic models. Times have a UTC offset, sizes are bytes.

They are the server's own response models (`shared.responses`). Fields that a newer server adds are
available as attributes, too.
"""

from __future__ import annotations

from shared.errors import Unprocessable
from shared.responses import ResponseModel, jobs, maps, reconstructions, similarity, tracks

Answer = ResponseModel
AddedModel = maps.ModelResponse
BatchItem = jobs.BatchItemResponse
CameraPose = similarity.CameraPoseResponse
Component = reconstructions.ComponentResponse
CoordinateProposal = reconstructions.CoordinateProposalResponse
CreatedKey = maps.CreatedKeyResponse
Deleted = jobs.DeletedPhotoResponse
DeletedMap = maps.DeletedMapResponse
DeletedTrack = tracks.DeletedTrackResponse
Estimate = similarity.EstimateResponse
EstimateLevel = similarity.EstimateLevelResponse
Evaluation = maps.EvaluationResponse
Generation = maps.GenerationResponse
GivenPlaces = reconstructions.GivenPlacesResponse
Key = maps.KeyResponse
Map = maps.MapResponse
MapFeatures = maps.LocalFeaturesResponse
Matches = similarity.MatchesResponse
OnePhoto = similarity.PhotoDetailResponse
OneTrack = tracks.TrackDetailResponse
Photo = similarity.PhotoResponse
PhotoHeader = reconstructions.PhotoHeaderResponse
PlaceProposal = reconstructions.StoredProposalResponse
PointPair = similarity.PointPair
PoseCamera = similarity.PoseCameraResponse
Progress = jobs.JobProgress
Proposal = reconstructions.ProposalResponse
Reconstruction = reconstructions.ReconstructionResponse
RemovedModel = maps.RemovedModelResponse
Search = maps.SearchHistoryEntry
SeenPoint = similarity.SeenPoint
Similar = similarity.SimilarityResponse
SimilarPhoto = similarity.SimilarPhotoResponse
Started = jobs.JobAccepted
Stats = maps.StatsResponse
Track = tracks.TrackResponse
TrackFrame = tracks.TrackFrameResponse
TrackState = tracks.TrackStateResponse
UndonePlaces = reconstructions.UndonePlacesResponse
Uploaded = jobs.UploadResponse
Vocabulary = maps.VocabularyResponse

FINISHED = ("succeeded", "failed", "cancelled")
"""The states in which a job ends."""


class Job(jobs.JobFields):
    """A job; `error` is an RFC 9457 problem."""

    @property
    def finished(self) -> bool:
        """Whether the job has succeeded, failed or been cancelled."""
        return self.state in FINISHED

    @property
    def failure(self) -> str:
        """Why the job did not succeed: the detail of its error, or its state."""
        return str((self.error or {}).get("detail", f"The job {self.job_id} is {self.state}."))

    def raise_for_failure(self) -> None:
        """Raise Unprocessable with the job's `code` (or `job_ended`) if it failed."""
        if self.finished and self.state != "succeeded":
            raise Unprocessable((self.error or {}).get("code", "job_ended"), self.failure)


class BatchStarted(Started):
    """A batch upload that was queued."""

    items_url: str
