"""Diffraction at a wedge by the uniform theory of diffraction, which replaces Sionna RT's implementation.

Sionna RT 2.2.0 adds the terms of the reflected rays with the wrong sign (`RadioMaterial._diffraction_matrix`): the total field
jumps at a reflection boundary by twice the reflected ray, and swapping transmitter and receiver changes the result. In a
furnished room its snapshots are further from the correct ones than those without any diffraction. This version is compared with
the textbook, and checked for continuity and reciprocity, in `tests/data_gen/test_physics.py`.

    D = -(D1 + D2) I + R_0 D4 + R_n D3

with the coefficients D1..D4 of Kouyoumjian and Pathak (Proc. IEEE 62, 1974, equation 25), and slab reflection coefficients R
of the two faces instead of +-1 (Luebbers, IEEE Trans. AP 32, 1984): R_0 at the angle of the incident ray to the 0-face, R_n at
that of the diffracted ray to the n-face, which makes it reciprocal.

Import this module only after `data_gen.llvm.ensure_backend()`.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import sionna.rt as rt
from sionna.rt.path_solvers.paths_buffer import PathsBuffer
from sionna.rt.utils import implicit_basis_vector
from sionna.rt.utils.electromagnetics import cot_times_f_utd, itu_coefficients_single_layer_slab
from sionna.rt.utils.jones import jones_matrix_from_real_imag, jones_matrix_rotator, transverse_basis_from_normal
from sionna.rt.utils.wedges import wedge_interior_angle


def diffraction_matrix(thickness: Any, to_world: Any, ki: Any, ko: Any, si: Any, eta: Any, wavenumber: Any) -> Any:
    """Returns the Jones matrix (4x4 real, implicit world basis) of a diffracted ray.

    Args:
        thickness: of the slab on both faces, metres.
        to_world: rotation from the local frame, whose z is the normal of the 0-face.
        ki, ko: directions of the incident and the diffracted ray, local.
        si: Sionna's record of the interaction: `dn_du` the edge, `dn_dv` the normal of the n-face (local), `dp_du` the path
            lengths (metres) after and before the edge.
        eta: complex relative permittivity.
        wavenumber: of the free-space wave, 1/metre.
    """
    edge, normal_n, normal_0 = si.dn_du, si.dn_dv, mi.Vector3f(0, 0, 1)
    exterior = dr.two_pi - wedge_interior_angle(normal_0, normal_n)
    n = exterior * dr.rcp(dr.pi)
    sin_beta = dr.safe_sqrt(1 - dr.square(dr.dot(ki, edge)))
    # Angles around the edge, from the 0-face through free space to the n-face.
    tangent = dr.normalize(dr.cross(normal_0, edge))
    phi_in, phi_out = (_angle(v, tangent, normal_0) for v in (-ki, ko))
    after, before = si.dp_du.x, si.dp_du.y
    kl = wavenumber * after * before * dr.rcp(after + before) * dr.square(sin_beta)

    def coefficient(sign: int, beta: Any) -> Any:
        turns = dr.round((beta + sign * dr.pi) * dr.rcp(2 * exterior))
        a = 2 * dr.square(dr.cos(exterior * turns - beta / 2))
        return factor * cot_times_f_utd((dr.pi + sign * beta) * dr.rcp(2 * n), kl * a, n, kl)

    complex_number: Any = mi.Complex2f  # to type checkers an object of no type
    factor = -dr.exp(complex_number(0, -dr.pi / 4)) * dr.rcp(2 * n * dr.sqrt(dr.two_pi * wavenumber) * sin_beta)
    minus, plus = phi_out - phi_in, phi_out + phi_in
    incident = -(coefficient(1, minus) + coefficient(-1, minus))
    real, imaginary = _diagonal(incident.real, incident.real), _diagonal(incident.imag, incident.imag)
    basis_in, basis_out = dr.normalize(dr.cross(ki, edge)), -dr.normalize(dr.cross(ko, edge))
    faces = (normal_0, dr.dot(ki, normal_0), coefficient(-1, plus)), (normal_n, dr.dot(ko, normal_n), coefficient(1, plus))
    for normal, cosine, weight in faces:
        te, tm, _, _ = itu_coefficients_single_layer_slab(dr.abs(cosine), eta, thickness, dr.two_pi / wavenumber)
        te, tm = te * weight, tm * weight
        # The components in the basis of the reflection boundary are those in the basis of the diffracted ray.
        reflected = dr.normalize(ki - 2 * dr.dot(ki, normal) * normal)
        transverse = transverse_basis_from_normal(ki, normal)
        into = jones_matrix_rotator(ki, basis_in, transverse)
        out = jones_matrix_rotator(reflected, transverse, -dr.normalize(dr.cross(reflected, edge)))
        real += out @ _diagonal(te.real, tm.real) @ into
        imaginary += out @ _diagonal(te.imag, tm.imag) @ into
    into = jones_matrix_rotator(ki, _implicit(to_world, ki), basis_in)
    out = jones_matrix_rotator(ko, basis_out, _implicit(to_world, ko))
    return jones_matrix_from_real_imag(out @ real @ into, out @ imaginary @ into)


def end_unused_vertices(paths: PathsBuffer, receivers: Any) -> None:
    """Moves the unused vertices after a path's last interaction to its receiver, in place.

    Sionna RT 2.2.0 computes the path length after the edge (`FieldCalculator._diffraction_compute_s_s_prime`) to the first
    unused vertex, wherever that is; with the vertex at the receiver the length is correct.
    """
    goal = dr.gather(mi.Point3f, receivers, paths.target_indices)
    for depth in range(1, paths.max_depth + 1):
        kind = paths.get_interaction_type(mi.UInt(depth), mi.Bool(True))
        paths.set_vertex(mi.UInt(depth), goal, kind == rt.InteractionType.NONE)


def _angle(direction: Any, tangent: Any, normal: Any) -> Any:
    angle = dr.atan2(dr.dot(direction, normal), dr.dot(direction, tangent))
    return dr.select(angle < 0, angle + dr.two_pi, angle)


def _diagonal(first: Any, second: Any) -> Any:
    return mi.Matrix2f(first, 0, 0, second)


def _implicit(to_world: Any, direction: Any) -> Any:
    """Returns Sionna's implicit basis vector of a direction, in the local frame."""
    return to_world.T @ implicit_basis_vector(to_world @ direction)
