//! Tests of the solids.

use super::*;
use proptest::prelude::*;

fn house(roof: Roof) -> Prism {
    let rect = Rect::new([3.0, 4.0], [0.8, 0.6], 6.0, 4.0);
    Prism { rect, bottom: 1.0, roof }
}

#[test]
fn roof_planes_in_closed_form() {
    let gable = house(Roof::Gable { ridge: 10.0, slope: 0.5 });
    let [x, y] = gable.rect.at(2.0, -3.0);
    let (z, face) = gable.top(x, y).expect("inside");
    assert!((z - 8.5).abs() < 1e-12);
    assert_eq!(face, Face::Top(1));
    let hip = house(Roof::Hip { ridge: 10.0, slope: 0.5 });
    for (u, v, expected) in [(0.0, 0.0, 10.0), (2.0, 0.0, 10.0), (6.0, 0.0, 8.0), (0.0, 4.0, 8.0)] {
        let [x, y] = hip.rect.at(u * (1.0 - 1e-12), v * (1.0 - 1e-12));
        let z = hip.top(x, y).expect("inside").0;
        assert!((z - expected).abs() < 1e-9, "{u} {v} {z}");
    }
    let shed = house(Roof::Plane { z: 5.0, du: 0.1, dv: -0.2 });
    let [x, y] = shed.rect.at(-1.0, 2.0);
    assert!((shed.top(x, y).expect("inside").0 - 4.5).abs() < 1e-12);
    assert!((shed.highest() - (5.0 + 0.6 + 0.8)).abs() < 1e-12);
    assert_eq!(shed.top(100.0, 0.0), None);
}

fn any_shape() -> impl Strategy<Value = Shape> {
    let prism = (0..3_u8, 0.5..8.0_f64, 0.5..8.0_f64, 0.0..6.3_f64, 0.0..0.9_f64).prop_map(
        |(kind, a, b, angle, slope)| {
            let (hu, hv) = (a.max(b), a.min(b));
            let rect = Rect::new([0.3, -0.2], [libm::cos(angle), libm::sin(angle)], hu, hv);
            let roof = match kind {
                0 => Roof::Plane { z: 5.0, du: slope / 3.0, dv: -slope / 4.0 },
                1 => Roof::Gable { ridge: 9.0, slope },
                _ => Roof::Hip { ridge: 9.0, slope },
            };
            Shape::Prism(Prism { rect, bottom: 0.5, roof })
        },
    );
    let cylinder = (0.5..6.0_f64).prop_map(|radius| {
        Shape::Cylinder(Cylinder { x: 0.5, y: -1.0, radius, bottom: 1.0, top: 6.0 })
    });
    let crown = (0.5..4.0_f64, 0.5..3.0_f64).prop_map(|(radius, half_height)| {
        let puff = |x: f64, z| Puff { center: [x, 0.0, z], radius, half_height };
        Shape::Crown(Crown {
            x: 0.0,
            y: 0.0,
            radius: radius + 1.0,
            bottom: 4.0 - half_height,
            top: 5.0 + half_height,
            puffs: vec![puff(-1.0, 4.0), puff(1.0, 5.0)],
            porosity: 0.0,
            pattern: 0,
        })
    });
    prop_oneof![prism, cylinder, crown]
}

proptest! {
    /// The oracle of the ray is the height function: a point of the ray just inside the exit
    /// is under the top, one just outside is not inside.
    #[test]
    fn rays_leave_where_the_height_function_says(
        shape in any_shape(),
        from in prop::array::uniform3(-8.0..8.0_f64), step in prop::array::uniform3(-1.0..1.0_f64),
    ) {
        let ray = Ray { from, step };
        let bottom = match &shape {
            Shape::Prism(p) => p.bottom,
            Shape::Cylinder(c) => c.bottom,
            Shape::Crown(_) => f64::NEG_INFINITY,
        };
        let inside = |t: f64| {
            let [x, y, z] = ray.at(t);
            shape.top(x, y).is_some_and(|(top, _)| z <= top && z >= bottom)
        };
        if let Some(span) = shape.clip(&ray) {
            prop_assert!(span.enter <= span.exit);
            let length = span.exit - span.enter;
            if length > 1e-6 {
                let e = length * 1e-6;
                prop_assert!(inside(span.exit - e));
                if !matches!(shape, Shape::Crown(_)) {
                    prop_assert!(inside(span.enter + e));
                    prop_assert!(!inside(span.exit + e) && !inside(span.enter - e));
                }
            }
            prop_assert!(shape.blocks(&ray, span.exit - 1e-9));
        } else {
            for k in -200..200 {
                let t = f64::from(k) * 0.1;
                // Convex bodies hold no point of a ray that misses them.
                if matches!(shape, Shape::Prism(_) | Shape::Cylinder(_)) {
                    prop_assert!(!inside(t), "{t}");
                }
            }
        }
    }

    #[test]
    fn a_vertical_ray_leaves_at_the_top(shape in any_shape(), x in -6.0..6.0_f64, y in -6.0..6.0_f64) {
        let ray = Ray { from: [x, y, 0.0], step: [0.0, 0.0, 1.0] };
        match (shape.top(x, y), shape.clip(&ray)) {
            (Some((z, face)), Some(span)) => {
                prop_assert!((span.exit - z).abs() < 1e-9);
                prop_assert_eq!(span.exit_face, face);
            }
            (None, None) => {}
            other => prop_assert!(false, "{:?}", other),
        }
    }

    /// Normals agree with finite differences of the height.
    #[test]
    fn normals_are_gradients(shape in any_shape(), x in -3.0..3.0_f64, y in -3.0..3.0_f64) {
        let h = 1e-6;
        let near = [(0.0, 0.0), (h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h)]
            .map(|(dx, dy)| shape.top(x + dx, y + dy));
        if let [Some((z, f)), Some((e, fe)), Some((w, fw)), Some((n, fn_)), Some((s, fs))] = near
            && [fe, fw, fn_, fs].iter().all(|g| *g == f)
        {
            let normal = shape.normal(f, [x, y, z]);
            let (gx, gy) = ((e - w) / (2.0 * h), (n - s) / (2.0 * h));
            // Near the rim of a spheroid differences are no measure.
            prop_assume!(gx.abs() < 5.0 && gy.abs() < 5.0);
            prop_assert!((-normal[0] / normal[2] - gx).abs() < 1e-3);
            prop_assert!((-normal[1] / normal[2] - gy).abs() < 1e-3);
        }
    }
}
