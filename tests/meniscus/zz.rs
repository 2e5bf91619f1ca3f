use glam::DVec3;
use meniscus::particles::Particles;
use meniscus::settings::*;
use meniscus::skin::skin;
#[test]
fn zz() {
    for r in [2.3, 2.8, 3.4, 4.0, 4.5, 5.6, 8.0] {
        for (name, integ) in [("fast", Integrator::Fast), ("implicit", Integrator::Implicit)] {
            for (lap, steps) in [(15, 1), (15, 5), (15, 20), (15, 50)] {
                let steps_n = if integ == Integrator::Explicit { steps * 400 } else { steps };
                let settings = Settings::resolve(
                    1.0,
                    &Choices {
                        radius_min: Some(r),
                        laplacian_steps: Some(lap),
                        steps: Some(steps_n),
                        step_size: Some(if steps > 5 { 100.0 / steps as f64 } else { 20.0 }),
                        integrator: Some(integ),
                        ..Choices::default()
                    },
                )
                .unwrap();
                let s = skin(&Particles::Double(vec![[0.3, 0.4, -0.2]]), &settings);
                let c = DVec3::new(0.3, 0.4, -0.2);
                let ds: Vec<f64> = s.mesh.positions.iter().map(|p| (p.as_dvec3() - c).length()).collect();
                let m = ds.iter().sum::<f64>() / ds.len() as f64;
                let vol = (s.report.mesh.volume * 3.0 / 4.0 / std::f64::consts::PI).cbrt();
                println!(
                    "ZZ r_init {:.2} {name} lap {lap} steps {steps}: vertices {m:.4} volume radius {vol:.4} expect lap {:.4}",
                    1.5 * r,
                    (2.25 * r * r - 0.4 * lap as f64).sqrt()
                );
            }
        }
    }
}
