"""The paper (arXiv:2307.14019), one file per stage.

| equation | says                               | function                 | file                   |
|----------|------------------------------------|--------------------------|------------------------|
| 1        | the problem: R, t of least squares | weighted_procrustes      | geometry/procrustes.py |
| 2        | 1-NN cloud: nearest other points   | nearest_neighbor         | geometry/neighbors.py  |
| -        | neighbourhoods of K points         | knn                      | geometry/neighbors.py  |
| -        | local features by a DGCNN          | DGCNN                    | features.py            |
| 3        | D = distance of features           | feature_distance         | matching.py            |
| 3        | M = softmax(-D) along a row        | matching_scores          | matching.py            |
| 4        | G: M summed over neighbourhoods    | neighborhood_sum         | matching.py            |
| 5        | D' = exp(alpha - G) (D + D^)       | final_distance           | matching.py            |
| 3-5      | the maps M, G and F                | matching_maps            | matching.py            |
| 6        | reference copy q~ = F q            | match                    | matching.py            |
| 3-6      | the same for large clouds          | match_in_blocks          | matching_blocks.py     |
| 7        | edges to the neighbours            | edges                    | invariants.py          |
| 7-8      | angles between them, by atan2      | included_angles          | invariants.py          |
| 8        | one angle                          | included_angle           | geometry/numerics.py   |
| 9-11     | structures compared, confidence w  | InlierNetwork            | inliers.py             |
| 12       | the N_c most confident             | select_inliers           | inliers.py             |
| 13       | weighted Procrustes of these       | weighted_procrustes      | geometry/procrustes.py |
| -        | N_l steps                          | iterate                  | model.py               |
| 14       | L_gc, global consistency           | global_consistency       | losses.py              |
| 15       | L_in, neighbourhood consistency    | neighborhood_consistency | losses.py              |
| 16       | L_gs, geometric consistency        | geometric_consistency    | losses.py              |
| 17       | L_sc, spatial consistency          | spatial_consistency      | losses.py              |
| 18       | their weighted sum over steps      | total_loss               | losses.py              |

Where the text is ambiguous, a field of `ModelConfig` or `LossConfig` selects the reading.
"""
