"""What is guaranteed, computed from a model and a domain: numbers for estimators and triggers."""

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.excitation import Direction, ExcitationMonitor, Information
from ctmhe.certificates.excitation_design import design_excitation
from ctmhe.certificates.excited_set import ExcitationDesign, ExcitedSet
from ctmhe.certificates.joint import (
    JointBound,
    JointCertificate,
    OnlineConditions,
    certify_jointly,
    joint_bound,
    search_jointly,
    uniform_excitation,
)
from ctmhe.certificates.joint_weights import JointWeights, StateDetectability, detect_states, joint_weights, unmet

__all__ = [
    "DetectabilityCertificate",
    "Direction",
    "ExcitationDesign",
    "ExcitationMonitor",
    "ExcitedSet",
    "Information",
    "JointBound",
    "JointCertificate",
    "JointWeights",
    "OnlineConditions",
    "StateDetectability",
    "certify_jointly",
    "design_excitation",
    "detect_states",
    "joint_bound",
    "joint_weights",
    "search_jointly",
    "uniform_excitation",
    "unmet",
]
