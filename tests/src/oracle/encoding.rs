const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// Row of a level's table that holds grid corner `corner` (D), for a level of `resolution` cells an
/// axis.
///
/// Dense, Σ c_j (N+1)^j, where the level's (N+1)^D corners fit 2^T rows; else the XOR of c_j · π_j
/// in wrapping u32, modulo 2^T (Müller et al. 2022, eq. 4).
///
/// # Panics
/// For more than 4 dimensions.
#[must_use]
pub fn hash_index(corner: &[u32], resolution: u32, log2_table_size: u32) -> usize {
    assert!(corner.len() <= PRIMES.len(), "hash_index: {} dimensions, at most {}", corner.len(), PRIMES.len());
    let side = u128::from(resolution) + 1;
    let rows = 1u128 << log2_table_size;
    if side.pow(corner.len() as u32) <= rows {
        let mut index = 0;
        for &c in corner.iter().rev() {
            index = index * side + u128::from(c);
        }
        return index as usize;
    }
    let mut hash = 0u32;
    for (c, prime) in corner.iter().zip(PRIMES) {
        hash ^= c.wrapping_mul(prime);
    }
    (u128::from(hash) % rows) as usize
}

/// Multiresolution hash encoding: `points` (Q × `dims`, from 0 to 1; clamped, NaN as 0), `table`
/// (L, 2^T, F) padded, one entry of `resolutions` a level; returns (Q, L·F), level by level.
///
/// # Panics
/// Where lengths do not fit each other.
#[must_use]
pub fn hash_encode(
    points: &[f64],
    dims: usize,
    resolutions: &[u32],
    table: &[f32],
    log2_table_size: u32,
    features: usize,
) -> Vec<f64> {
    let rows = 1usize << log2_table_size;
    assert_eq!(table.len(), resolutions.len() * rows * features, "hash_encode: table is not (L, 2^T, F)");
    assert_eq!(points.len() % dims, 0, "hash_encode: points are not (Q, {dims})");
    let mut encoded = Vec::new();
    for point in points.chunks(dims) {
        for (level, &resolution) in resolutions.iter().enumerate() {
            let mut cell = vec![0u32; dims];
            let mut fraction = vec![0.0f64; dims];
            for j in 0..dims {
                let x = if point[j].is_nan() { 0.0 } else { point[j].clamp(0.0, 1.0) };
                let p = x * f64::from(resolution);
                cell[j] = (p.floor() as u32).min(resolution - 1);
                fraction[j] = p - f64::from(cell[j]);
            }
            let mut sum = vec![0.0f64; features];
            for mask in 0..1usize << dims {
                let mut weight = 1.0;
                let mut corner = cell.clone();
                for j in 0..dims {
                    if mask >> j & 1 == 1 {
                        corner[j] += 1;
                        weight *= fraction[j];
                    } else {
                        weight *= 1.0 - fraction[j];
                    }
                }
                let row = level * rows + hash_index(&corner, resolution, log2_table_size);
                for f in 0..features {
                    sum[f] += weight * f64::from(table[row * features + f]);
                }
            }
            encoded.extend(sum);
        }
    }
    encoded
}
